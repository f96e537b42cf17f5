"""Sizes and state of the training loop, and what a chunk of it reports.

`train_loop` says what a vector step, a round and a chunk are.
"""

from typing import Any, NamedTuple

import jax

from rewire_jax.training import replay_buffer, rollout, sac


class LoopConfig(NamedTuple):
    """Static sizes of the loop.

    Attributes:
      envs: parallel environments of a member.
      updates: SAC updates in a round.
      warmup: vector steps of a task before its first round of updates.
      random_steps: vector steps with uniform actions, at the start of a task.
      transitions: vector steps that the buffer holds.
      update_every: vector steps between two rounds of updates.
      overlap: whether environments on the host step during updates (`--overlap`).
    """

    envs: int
    updates: int
    warmup: int
    random_steps: int
    transitions: int
    update_every: int = 1
    overlap: bool = False

    def due(self, steps: Any) -> Any:
        """Whether a round of updates follows vector step `steps`, an int or `[]`."""
        return (steps % self.update_every == 0) & (steps > self.warmup)

    def before(self, steps: Any) -> Any:
        """Counts updates before the round that follows vector step `steps`."""
        rounds = steps // self.update_every - self.warmup // self.update_every
        return (rounds - 1) * self.updates


class CollectorState(NamedTuple):
    """The part of a member's state that collecting changes.

    Attributes:
      buffer: the replay buffer.
      episodes: `[envs]` environments.
      extras: result of the latest call of `Method.extras`.
    """

    buffer: replay_buffer.Replay
    episodes: rollout.Episode
    extras: Any


class RunnerState(NamedTuple):
    """A member in the middle of a task.

    Attributes:
      learner: the part that updates change.
      collection: the part that collecting changes.
      active: `[]` bool; if False, the learner is no longer updated.
      acting: parameters and method's state that act next; `()` without overlap.
    """

    learner: sac.TrainState
    collection: CollectorState
    active: jax.Array
    acting: Any = ()


class ChunkMetrics(NamedTuple):
    """Sums and counts over a chunk.

    Attributes:
      episodes: `[]`, number of training episodes that ended.
      returns: `[]`, sum of the returns of these episodes.
      rewards: `[]`, sum over vector steps of the mean reward over environments.
      updates: `[]`, number of rounds of updates.
      metrics: sums over these rounds of the metrics of each round's last update.
      inspected: metrics of `Method.inspect` at the end of the chunk.
      successes: `rollout.Success` of `[]`, solved episodes; `()` if not defined.
    """

    episodes: jax.Array
    returns: jax.Array
    rewards: jax.Array
    updates: jax.Array
    metrics: sac.Metrics
    inspected: sac.Metrics
    successes: Any = ()
