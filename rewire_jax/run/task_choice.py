"""Evaluation without task labels: the policy is chosen by its return in trials."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.arguments import check_whole
from rewire_jax.core.settings import MOST_EPISODES
from rewire_jax.methods.shared import map_own
from rewire_jax.run import episode_parts, halving
from rewire_jax.run.halving import Array
from rewire_jax.training import population
from rewire_jax.training.run_setup import Plan, prepare

# Splits of a key are folds by small numbers, which the evaluation uses.
_TRIALS = np.uint32(2**31)


class Trials(NamedTuple):
    """How a policy is chosen.

    Attributes:
      trials: how often each remaining candidate plays in a round.
      steps: length of a trial, from a reset; a whole episode if None.
      seed: seed of the trials.
    """

    trials: int
    steps: int | None
    seed: int


class Choice(NamedTuple):
    """The chosen policies, `[members, tasks]` each.

    Attributes:
      place: index of the task to which the chosen policy belongs; the first of them if
        policies are equal.
      recognised: whether the policy is that of the task, at any of its places in the
        sequence.
      trained: whether the task was trained before; others cannot be recognised.
      candidates: number of different policies among which the choice was made.
      interactions: steps of all trials.
    """

    place: NDArray[np.intp]
    recognised: NDArray[np.bool_]
    trained: NDArray[np.bool_]
    candidates: NDArray[np.intp]
    interactions: NDArray[np.intp]


def choose(plan: Plan, policies: Any, finished: int, how: Trials) -> Choice:
    """Chooses one of each member's policies for each task, without its label.

    Args:
      plan: plan of the run.
      policies: `[members, tasks]`; `[members]` if `Shared`.
      finished: number of tasks trained so far; their policies are the candidates.
      how: how to choose.

    Raises:
      UserError: a number in `how` is out of range, or the memory is too small.
    """
    length = plan.scenario.environment.episode_length
    steps = length if how.steps is None else how.steps
    check_whole("--trials", how.trials, 1, MOST_EPISODES)
    check_whole("--trial-steps", steps, 1, length)
    short = _shortened(plan, steps)
    num_slots, tasks = plan.num_slots, len(plan.names)
    interactions = np.zeros((num_slots, tasks), int)

    def play(candidates: Array, playing: Array, round_: int) -> Array:
        width = candidates.shape[-1]
        played = episode_parts.play(
            short,
            jax.tree.map(lambda leaf: np.repeat(leaf, width, axis=0), plan.tasks),
            pick(plan, policies, candidates.reshape(num_slots, -1)),
            _keys(how.seed, round_, candidates).reshape(num_slots, -1),
            how.trials,
        )
        lengths = played.lengths.sum(axis=-1).reshape(candidates.shape)
        interactions[...] += (lengths * playing).sum(axis=-1)
        return np.reshape(played.returns.mean(axis=-1), candidates.shape)

    first = _first_equal(policies, num_slots, finished)
    own = [np.unique(row) for row in first]
    width = max(len(row) for row in own)
    padded = np.array([np.resize(row, width) for row in own])
    count = np.array([[len(row)] * tasks for row in own])
    place = halving.choose(play, np.repeat(padded[:, None], tasks, axis=1), count)

    distinct = np.array([task.distinct for task in plan.scenario.tasks[:tasks]])
    its = distinct[:finished] == distinct[:, None]  # [tasks, finished]
    same = first[:, None] == place[..., None]  # [members, tasks, finished]
    return Choice(
        place=place,
        recognised=(same & its).any(axis=-1),
        trained=np.broadcast_to(its.any(axis=-1), place.shape),
        candidates=count,
        interactions=interactions,
    )


def pick(plan: Plan, policies: Any, places: Array) -> Any:
    """A member's policies at `places` `[members, rows]`, as if of these rows."""
    rows = np.arange(plan.num_slots)[:, None]
    return population.place(map_own(lambda x: x[rows, places], policies), plan.mesh)


def _shortened(plan: Plan, steps: int) -> Plan:
    """A plan whose episodes end after `steps` steps."""
    environment = plan.scenario.environment._replace(episode_length=steps)
    scenario = dataclasses.replace(plan.scenario, environment=environment)
    return prepare(plan.settings, scenario)


def _first_equal(policies: Any, num_slots: int, finished: int) -> NDArray[np.intp]:
    """`[members, finished]`, see `halving.first_equal`."""
    there = map_own(np.asarray, policies)

    def one(member: int, place: int) -> Any:
        return map_own(lambda leaf: leaf[member, place], there)

    return np.array(
        [
            halving.first_equal([one(member, place) for place in range(finished)])
            for member in range(num_slots)
        ]
    )


@jax.jit
def _keys(seed: jax.Array, round_: jax.Array, candidates: jax.Array) -> jax.Array:
    """Keys `[members, tasks, k]`; a policy's keys do not depend on other policies."""
    fold = jax.random.fold_in
    root = fold(fold(jax.random.key(seed), _TRIALS), round_)

    def one(member, task, place):
        return fold(fold(fold(root, member), task), place)

    members, tasks, _ = candidates.shape
    of_task = jax.vmap(jax.vmap(one, (None, None, 0)), (None, 0, 0))
    of_member = jax.vmap(of_task, (0, None, 0))
    return of_member(jnp.arange(members), jnp.arange(tasks), candidates)
