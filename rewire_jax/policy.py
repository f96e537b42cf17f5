"""Policies of a finished or running run, as plain functions."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax import checkpoint, config, runfolder, standing, sweeping
from rewire_jax.axes import configure
from rewire_jax.errors import UserError
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Method, Spec

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
    if runfolder.kind(folder) == "sweep":
        source = _of_sweep(folder, seed, stage, member)
    else:
        source = _of_run(folder, seed, stage, member)
    tasks = source.spec.tasks
    if not 0 <= task < tasks:
        raise UserError(f"{folder} has tasks 0 to {tasks - 1}, not {task}")
    keys = jax.vmap(jax.random.key)(jnp.arange(source.places))
    like = {"policy": jax.eval_shape(jax.vmap(source.method.init), keys)}
    items, _ = checkpoint.load(source.path, like)
    params, memory = jax.tree.map(
        lambda leaf: jnp.asarray(leaf[source.place]), items["policy"]
    )
    policy = source.method.policy(params, memory, jnp.asarray(task))

    def act(observation: jax.Array) -> jax.Array:
        mean, _ = source.method.act(policy, observation)
        return jnp.tanh(mean)

    return act


class _Source(NamedTuple):
    """Where a member's policies are: its method, a checkpoint and its place there."""

    method: Method
    spec: Spec
    path: Path
    place: int
    places: int


def _of_run(
    folder: Path, seed: int | None, stage: int | None, member: int | None
) -> _Source:
    header = runfolder.read_header(folder)
    entry = find_method(header["settings"]["method"])
    settings = config.from_json(header["settings"], entry.settings)
    seed = settings.seed if seed is None else seed
    place = seed - settings.seed if member is None else member
    if not 0 <= place < settings.seeds:
        raise UserError(f"{folder} has no seed {seed}: see {runfolder.HEADER} there")
    spec = Spec(**header["spec"])
    return _Source(
        method=entry.make(spec, settings.options),
        spec=spec,
        path=standing.kept(folder, stage),
        place=place,
        places=settings.seeds,
    )


def _of_sweep(
    folder: Path, seed: int | None, stage: int | None, member: int | None
) -> _Source:
    header = runfolder.read_header(folder, "sweep")
    if member is None or seed is not None:
        raise UserError(f"{folder} holds a sweep: give member, a number in members.csv")
    if not 0 <= member < len(header["members"]):
        raise UserError(f"{folder} has no member {member}: see members.csv there")
    entry = find_method(header["settings"]["method"])
    shared = config.from_json(header["settings"], entry.settings)
    values = header["members"][member]["values"]
    spec = Spec(**header["spec"])
    found = sweeping.find(folder, member, stage)
    return _Source(
        method=entry.make(spec, configure(shared, values).options),
        spec=spec,
        path=standing.kept(found.folder, found.stage),
        place=found.place,
        places=found.places,
    )
