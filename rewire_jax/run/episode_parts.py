"""Many episodes, played in parts if the memory does not hold all of them."""

from typing import Any

import jax
import numpy as np

from rewire_jax.envs.base import Task
from rewire_jax.training import memory_estimate
from rewire_jax.training.rollout import Rollout
from rewire_jax.training.run_setup import Plan

_others = jax.jit(jax.vmap(jax.vmap(jax.random.fold_in, (0, None)), (0, None)))


def play(
    plan: Plan, tasks: Task, policies: Any, keys: jax.Array, episodes: int
) -> Rollout:
    """Plays whole episodes without exploration.

    Args:
      plan: plan of the run.
      tasks: pytree with a leading axis `[rows]`.
      policies: `[members, rows]`; `[members]` if `Shared`.
      keys: `[members, rows]`.
      episodes: number for each member and row.

    Returns:
      `[members, rows, episodes]`, on the host.

    Raises:
      UserError: the memory does not hold one episode of each member and row.
    """
    rows = keys.shape[1]
    at_once = memory_estimate.episodes_at_once(plan, policies, rows, episodes)
    parts = []
    for part in range(-(-episodes // at_once)):
        rolled = plan.program.rollout(tasks, policies, keys, at_once)
        parts.append(jax.tree.map(np.asarray, rolled))
        keys = _others(keys, part)
    return jax.tree.map(lambda *x: np.concatenate(x, axis=2)[..., :episodes], *parts)
