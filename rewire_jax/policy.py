"""Policies of a finished or running run, as plain functions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from rewire_jax import checkpoint, config, runfolder, standing
from rewire_jax.errors import UserError
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Method, Spec

PolicyFunction = Callable[[jax.Array], jax.Array]
"""`[..., observations]` -> actions `[..., actions]` in [-1, 1]."""


def load_policy(
    run: str | Path, *, task: int, seed: int | None = None, stage: int | None = None
) -> PolicyFunction:
    """A learned policy as a pure function; nothing but the run's folder is needed.

    Args:
      run: folder of the run.
      task: which task of the sequence to act in, from 0. A task not yet learned at
        that stage gets the latest policy.
      seed: of which member; the run's first if None.
      stage: as it was after this task's training; after the latest if None.

    Returns:
      Observation `[..., observations]` (as the scenario's environment gives it) to
      action `[..., actions]`, without exploration. It can be jitted and vmapped.

    Raises:
      UserError: no such run, task, seed or stage, or a damaged checkpoint.
    """
    folder = Path(run)
    header = runfolder.read_header(folder)
    entry = find_method(header["settings"]["method"])
    settings = config.from_json(header["settings"], entry.settings)
    seed = settings.seed if seed is None else seed
    member = seed - settings.seed
    if not 0 <= member < settings.seeds:
        raise UserError(f"{folder} has no seed {seed}: see {runfolder.HEADER} there")
    if not 0 <= task < settings.tasks:
        raise UserError(f"{folder} has tasks 0 to {settings.tasks - 1}, not {task}")
    method = entry.make(Spec(**header["spec"]), settings.options)
    params, memory = jax.tree.map(
        lambda leaf: jnp.asarray(leaf[member]),
        _load(folder, stage, method, settings.seeds),
    )
    policy = method.policy(params, memory, jnp.asarray(task))

    def act(observation: jax.Array) -> jax.Array:
        mean, _ = method.act(policy, observation)
        return jnp.tanh(mean)

    return act


def _load(folder: Path, stage: int | None, method: Method, members: int) -> Any:
    keys = jax.vmap(jax.random.key)(jnp.arange(members))
    like = jax.eval_shape(jax.vmap(method.init), keys)
    path = standing.kept(folder, stage)
    return checkpoint.load(path, {"policy": like})[0]["policy"]
