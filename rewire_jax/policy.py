"""Policies of a finished or running run, as plain functions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from rewire_jax import checkpoint, config, runfolder, standing, sweeping
from rewire_jax.axes import configure
from rewire_jax.errors import UserError
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Method, Spec
from rewire_jax.sweeping import Found

PolicyFunction = Callable[[jax.Array], jax.Array]
"""`[..., observations]` -> actions `[..., actions]` in [-1, 1]."""


def load_policy(
    run: str | Path,
    *,
    task: int,
    seed: int | None = None,
    stage: int | None = None,
    member: int | None = None,
) -> PolicyFunction:
    """A learned policy as a pure function; nothing but the run's folder is needed.

    Args:
      run: folder of the run, or of a sweep.
      task: which task of the sequence to act in, from 0. A task not yet learned at
        that stage gets the latest policy.
      seed: of which member; the run's first if None.
      stage: as it was after this task's training; after the latest if None.
      member: of a sweep, in place of the seed; its number, as in members.csv.

    Returns:
      Observation `[..., observations]` (as the scenario's environment gives it) to
      action `[..., actions]`, without exploration. It can be jitted and vmapped.

    Raises:
      UserError: no such run, task, seed, member or stage, or a damaged checkpoint.
    """
    folder = Path(run)
    kind = runfolder.kind(folder)
    header = runfolder.read_header(folder, kind)
    entry = find_method(header["settings"]["method"])
    settings = config.from_json(header["settings"], entry.settings)
    spec = Spec(**header["spec"])
    if not 0 <= task < spec.tasks:
        raise UserError(f"{folder} has tasks 0 to {spec.tasks - 1}, not {task}")
    if kind == "sweep":
        if member is None or seed is not None:
            raise UserError(
                f"{folder} holds a sweep: give member, a number in members.csv"
            )
        if not 0 <= member < len(header["members"]):
            raise UserError(f"{folder} has no member {member}: see members.csv there")
        found = sweeping.find(folder, member, stage)
        settings = configure(settings, header["members"][member]["values"])
    else:
        if member is not None:
            raise UserError(f"{folder} holds a run: give seed, not member")
        seed = settings.seed if seed is None else seed
        found = Found(folder, stage, seed - settings.seed, settings.seeds)
        if not 0 <= found.place < found.places:
            raise UserError(
                f"{folder} has no seed {seed}: see {runfolder.HEADER} there"
            )
    method = entry.make(spec, settings.options)
    params, memory = jax.tree.map(
        lambda leaf: jnp.asarray(leaf[found.place]), _load(found, method)
    )
    policy = method.policy(params, memory, jnp.asarray(task))

    def act(observation: jax.Array) -> jax.Array:
        mean, _ = method.act(policy, observation)
        return jnp.tanh(mean)

    return act


def _load(found: Found, method: Method) -> Any:
    keys = jax.vmap(jax.random.key)(jnp.arange(found.places))
    like = {"policy": jax.eval_shape(jax.vmap(method.init), keys)}
    path = standing.kept(found.folder, found.stage)
    return checkpoint.load(path, like)[0]["policy"]
