"""What each random key is for: a key is split into named ones, never by index.

Keys of a member come from its seed, those of a task from the member's and the task's
index, those of a step from the task's and the number of the step. So what is drawn
does not depend on chunks, on checkpoints, or on other members.
"""

from enum import IntEnum
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

Keys = TypeVar("Keys", bound="NamedTuple")


class Stream(IntEnum):
    """What a member's key is folded with first; training has 1, the first state 0."""

    TRAINING = 1
    EVALUATION = 2
    SELECTION = 3
    CHOICE = 4
    CHANGE = 5


class TaskKeys(NamedTuple):
    """A task's keys.

    Attributes:
      start: see `StartKeys`.
      steps: key of the steps; each step folds its number into it.
      consolidate: key of `Method.consolidate`.
      offline: key of the offline updates.
    """

    start: jax.Array
    steps: jax.Array
    consolidate: jax.Array
    offline: jax.Array


class StartKeys(NamedTuple):
    """Keys of a task's start.

    Attributes:
      method: key of `Method.start_task`.
      reset: key of the environments.
      critic: key of fresh critics.
      extras: key of the first extras.
    """

    method: jax.Array
    reset: jax.Array
    critic: jax.Array
    extras: jax.Array


class StepKeys(NamedTuple):
    """Keys of a step of all environments of a member.

    Attributes:
      collect: see `CollectKeys`.
      update: key of the updates after it.
      inspect: key of the batch for `Method.inspect`.
      noise: key of the coloured noise of the episode that starts here.
    """

    collect: jax.Array
    update: jax.Array
    inspect: jax.Array
    noise: jax.Array


class UpdateKeys(NamedTuple):
    """Keys of a round of updates.

    Attributes:
      indices: key of the transitions.
      draws: key of the updates' draws.
      redo: see `RedoKeys`.
    """

    indices: jax.Array
    draws: jax.Array
    redo: jax.Array


class RedoKeys(NamedTuple):
    """Keys of a reset of dormant neurons.

    Attributes:
      batch: key of the batch on which they are dormant.
      critic: key of the critics' new weights.
      policy: key of the policy's new weights.
    """

    batch: jax.Array
    critic: jax.Array
    policy: jax.Array


class CollectKeys(NamedTuple):
    """Keys of a step's actions.

    Attributes:
      context: key of the method's context.
      action: key of the policy's noise.
      uniform: key of uniform actions.
      extras: key of the method's extras.
      reset: key of environments that start an episode.
    """

    context: jax.Array
    action: jax.Array
    uniform: jax.Array
    extras: jax.Array
    reset: jax.Array


def named(kind: type[Keys], key: jax.Array) -> Keys:
    """The keys of a kind that one key is split into."""
    return kind(*jax.random.split(key, len(kind._fields)))


def of_task(key: jax.Array, index: jax.Array) -> TaskKeys:
    """The keys of a member's task.

    A key is either split or folded, never both: `split(key)[i]` is the same as
    `fold_in(key, i)`.
    """
    key = jax.random.fold_in(jax.random.fold_in(key, Stream.TRAINING), index)
    return named(TaskKeys, key)


def of_step(key: jax.Array, time: jax.Array) -> StepKeys:
    """A step's keys, from `TaskKeys.steps` and the steps made before in the task."""
    return named(StepKeys, jax.random.fold_in(key, time))


def of_rollout(
    key: jax.Array, stream: int | jax.Array, number: int | jax.Array, rows: int
) -> jax.Array:
    """`[rows]`, a member's keys for rows of episodes, the `number`th of a stream."""
    key = jax.random.fold_in(jax.random.fold_in(key, stream), number)
    # Unlike those of a split, the first do not depend on how many there are.
    return jax.vmap(lambda row: jax.random.fold_in(key, row))(jnp.arange(rows))
