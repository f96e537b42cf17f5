"""Whole episodes in environments that are stepped on the host."""

# The records below have JAX arrays as types; here they contain NumPy arrays.
# mypy: disable-error-code="arg-type"

import functools
import itertools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rewire_jax.envs.base import HostEnvironment, Task
from rewire_jax.envs.vector_env import VectorEnv, draw_seed, open_lanes, shown
from rewire_jax.methods.shared import map_own
from rewire_jax.training.rollout import Rollout, Success

Array = NDArray[Any]


@functools.lru_cache
def _greedy(act: Callable[..., Any]) -> Callable[..., jax.Array]:
    """`(policies [lanes], observations [lanes]) -> actions`, without exploration."""
    return jax.jit(lambda policy, seen: jnp.tanh(jax.vmap(act)(policy, seen)[0]))


def play(
    environment: HostEnvironment,
    envs: int,
    act: Callable[..., Any],
    tasks: Task,
    policies: Any,
    keys: jax.Array,
    count: int,
) -> Rollout:
    """Plays whole episodes without exploration, see `rollout.episodes`.

    `envs` is how many lanes each member has.
    """
    members, rows = keys.shape
    lanes = open_lanes(environment, members * envs)
    roots = np.asarray(jax.random.key_data(keys))
    played = (members, rows, count)
    returns, lengths = np.zeros(played, np.float32), np.zeros(played, np.int32)
    solved = [np.zeros(played, bool) for _ in range(2)]
    for row in range(rows):
        # What is asked for at each step must lie ready.
        task = jax.tree.map(lambda leaf, row=row: np.asarray(leaf[row]), tasks)
        places = list(itertools.product(range(members), range(count)))
        while places:
            # The last lanes may play what others play, too.
            turn = list(itertools.islice(itertools.cycle(places), len(lanes.seeds)))
            places = places[len(turn) :]
            who, which = np.array(turn).T
            at = who, np.full(len(turn), row), which
            seeds = [draw_seed(*roots[m, row], e) for m, e in turn]
            of_task = map_own(operator.itemgetter((slice(None), row)), policies)
            policy = jax.tree.map(lambda leaf, w=who: leaf[w], of_task)
            result = _play(environment, lanes, act, task, policy, seeds)
            for kept, values in zip((returns, lengths, *solved), result, strict=True):
                kept[at] = values
    success = Success(*solved) if environment.success else ()
    return Rollout(returns, lengths, success)


def _play(
    environment: HostEnvironment,
    lanes: VectorEnv,
    act: Callable[..., Any],
    task: Task,
    policy: Any,
    seeds: list[int],
) -> tuple[Array, Array, Array, Array]:
    """An episode in each lane: return, length, success at any and at the last step."""
    size = len(seeds)
    observation = lanes.reset(int(task.physics), seeds)
    active, any_, last = np.ones(size, bool), np.zeros(size, bool), np.zeros(size, bool)
    returns, lengths = np.zeros(size, np.float32), np.zeros(size, np.int32)
    for _ in range(environment.episode_length):
        action = np.asarray(_greedy(act)(policy, shown(observation, task, (size,))))
        moment = lanes.step(action * np.asarray(task.action_scale))
        returns, lengths = (
            returns + np.where(active, moment.reward, 0),
            lengths + active,
        )
        any_, last = (
            any_ | (active & moment.success),
            np.where(active, moment.success, last),
        )
        active = active & ~moment.terminal
        if not active.any():
            break
        observation = moment.observation
        if moment.terminal.any():
            # An ended episode must be reset before a step; its rewards no longer count.
            observation = lanes.reset(lanes.task, seeds, moment.terminal)
    return returns, lengths, any_, last
