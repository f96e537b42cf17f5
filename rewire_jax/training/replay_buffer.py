"""A ring buffer of transitions that stores each observation once."""

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from rewire_jax.core.transition import Batch


class Replay(NamedTuple):
    """Transitions of `envs` parallel environments, one row per time step.

    The transition at time t is in row t mod rows. Its next observation is in the next
    row. After the time limit cut an episode, the next row holds a fresh start instead;
    then `final` holds the true last observation. Two cuts in one environment are at
    least one episode length apart, so t // episode_length identifies a cut.

    The caller keeps the time. It is equal for all members of a population, so writes
    stay in place under vmap.

    Attributes:
      observation: `[rows, envs, observations]`.
      action: `[rows, envs, actions]`.
      reward: `[rows, envs]`.
      terminal: `[rows, envs]` bool, ended by the task.
      truncated: `[rows, envs]` bool, ended by the time limit.
      final: `[cuts, envs, observations]`.
      extras: pytree of `[rows, envs, ...]`, extra data of the method.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    terminal: jax.Array
    truncated: jax.Array
    final: jax.Array
    extras: Any = ()


def create(
    first: jax.Array,
    *,
    transitions: int,
    actions: int,
    episode_length: int,
    extras: Any = (),
) -> Replay:
    """An empty buffer.

    Args:
      first: `[envs, observations]`, the observations at time 0.
      transitions: rows of transitions to hold; one more row holds the observation
        after the last.
      actions: length of an action.
      episode_length: steps to a time limit.
      extras: pytree of `[envs, ...]`, an example of the method's extra data.
    """
    envs, size = first.shape
    rows = transitions + 1
    cuts = -(-rows // episode_length) + 1
    return Replay(
        observation=jnp.zeros((rows, envs, size), first.dtype).at[0].set(first),
        action=jnp.zeros((rows, envs, actions), first.dtype),
        reward=jnp.zeros((rows, envs), first.dtype),
        terminal=jnp.zeros((rows, envs), bool),
        truncated=jnp.zeros((rows, envs), bool),
        final=jnp.zeros((cuts, envs, size), first.dtype),
        extras=jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), extras),
    )


def add(
    replay: Replay,
    time: jax.Array,
    *,
    action: jax.Array,
    reward: jax.Array,
    terminal: jax.Array,
    truncated: jax.Array,
    final_obs: jax.Array,
    next_obs: jax.Array,
    episode_length: int,
    extras: Any = (),
) -> Replay:
    """Stores the transitions of one time step.

    Args:
      replay: the buffer.
      time: `[]` int, steps since the buffer was made.
      action: `[envs, actions]`.
      reward: `[envs]`.
      terminal: `[envs]` bool.
      truncated: `[envs]` bool.
      final_obs: `[envs, observations]`, the observation that the step led to.
      next_obs: `[envs, observations]`, the same; for an ended episode, the first
        observation of the next one.
      episode_length: as in `create`.
      extras: as in `create`.

    Raises:
      AssertionError: the shapes are not those of the buffer.
    """
    chex.assert_shape([final_obs, next_obs], replay.observation.shape[1:])
    chex.assert_shape(action, replay.action.shape[1:])
    chex.assert_shape([reward, terminal, truncated], replay.reward.shape[1:])
    chex.assert_type([terminal, truncated], bool)
    rows, cuts = replay.reward.shape[0], replay.final.shape[0]

    def put(array, row, value):
        return jax.lax.dynamic_update_index_in_dim(array, value, row, 0)

    row, cut = time % rows, (time // episode_length) % cuts
    kept = jax.lax.dynamic_index_in_dim(replay.final, cut, 0, keepdims=False)
    return Replay(
        observation=put(replay.observation, (time + 1) % rows, next_obs),
        action=put(replay.action, row, action),
        reward=put(replay.reward, row, reward),
        terminal=put(replay.terminal, row, terminal),
        truncated=put(replay.truncated, row, truncated),
        final=put(replay.final, cut, jnp.where(truncated[:, None], final_obs, kept)),
        extras=jax.tree.map(lambda a, v: put(a, row, v), replay.extras, extras),
    )


def restart(replay: Replay, time: jax.Array, first: jax.Array) -> Replay:
    """Replaces the observations from which the next step starts.

    Args:
      replay: the buffer.
      time: `[]` int, time steps stored so far.
      first: `[envs, observations]`; the same as before in running episodes.
    """
    row = time % len(replay.reward)
    return replay._replace(observation=replay.observation.at[row].set(first))


def sample_indices(
    replay: Replay, key: jax.Array, time: jax.Array, shape: tuple[int, ...]
) -> jax.Array:
    """Indices of transitions for `take`, uniform with replacement.

    Args:
      replay: the buffer.
      key: a random key.
      time: `[]` int, the number of time steps stored so far, at least 1.
      shape: shape of the result.
    """
    rows, envs = replay.reward.shape
    filled = jnp.minimum(time, rows - 1)
    return jax.random.randint(key, shape, 0, filled * envs)


def extras_at(replay: Replay, indices: jax.Array, time: jax.Array) -> Any:
    """The method's extra data of the transitions at some indices, see `take`."""
    at, env = _find(replay, indices, time)
    row = at % len(replay.reward)
    return jax.tree.map(lambda a: a[row, env], replay.extras)


def take(
    replay: Replay, indices: jax.Array, time: jax.Array, episode_length: int
) -> Batch:
    """The transitions at some indices; index 0 is in the latest step.

    Args:
      replay: the buffer.
      indices: `[batch]` int, less than the number of transitions held.
      time: `[]` int, the number of time steps stored so far, at least 1.
      episode_length: as in `create`.
    """
    rows = len(replay.reward)
    at, env = _find(replay, indices, time)
    row = at % rows
    cut = (at // episode_length) % replay.final.shape[0]
    truncated = replay.truncated[row, env]
    return Batch(
        observation=replay.observation[row, env],
        action=replay.action[row, env],
        reward=replay.reward[row, env],
        terminal=replay.terminal[row, env],
        truncated=truncated,
        next_observation=jnp.where(
            truncated[:, None],
            replay.final[cut, env],
            replay.observation[(row + 1) % rows, env],
        ),
        extras=extras_at(replay, indices, time),
    )


def _find(replay, indices, time):
    """Times and environments of some indices."""
    envs = replay.reward.shape[1]
    return time - 1 - indices // envs, indices % envs


def sample(
    replay: Replay, key: jax.Array, time: jax.Array, batch: int, episode_length: int
) -> Batch:
    """`batch` transitions, uniform with replacement, see `take`."""
    return take(
        replay, sample_indices(replay, key, time, (batch,)), time, episode_length
    )
