"""Notices a change of task from what the environment does.

A linear model of the environment is fitted to the last chunks of transitions and
predicts the newest chunk. After a change, its errors leave their usual range.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve

from rewire_jax.training import replay_buffer

WINDOW = 10
"""Chunks to which the model is fitted."""
HISTORY = 20
"""Latest scores with which a new one is compared."""
_LEAST = 10  # scores
_RIDGE = 1e-3
_SMALLEST_LOG = 0.1  # error ÷ usual error below which errors count alike
_QUARTILES = 1.35  # standard deviations between the quartiles of a normal distribution
_FLOOR = 0.02  # added to the scores' spread
_TINY = 1e-8


def surprise(
    buffer: replay_buffer.Replay, time: jax.Array, chunk: int, episode_length: int
) -> jax.Array:
    """Returns `[]`, how badly a model of the last chunks predicts the newest one.

    The model is a ridge regression from observation and action to the change of the
    observation and the reward. The score is the mean over the newest chunk of
    log(|error| / usual + 0.1), where `usual` is the median of |error| in the chunks to
    which the model was fitted. Terminal transitions are left out.

    Args:
      buffer: buffer of one member.
      time: `[]` int, vector steps stored; at least `(WINDOW + 1) * chunk`.
      chunk: vector steps in a chunk.
      episode_length: as for the buffer.
    """
    newest = chunk * buffer.reward.shape[1]
    indices = jnp.arange((WINDOW + 1) * newest)
    batch = replay_buffer.take(buffer, indices, time, episode_length)
    inputs = jnp.concatenate([batch.observation, batch.action], axis=-1)
    change = batch.next_observation - batch.observation
    outputs = jnp.concatenate([change, batch.reward[:, None]], axis=-1)
    kept = ~batch.terminal[:, None]

    def mean(x):
        return jnp.sum(x * fitted, axis=0) / jnp.maximum(jnp.sum(fitted), 1)

    fitted = kept & (indices >= newest)[:, None]
    inputs -= mean(inputs)
    inputs /= jnp.sqrt(mean(inputs**2)) + _TINY
    outputs -= mean(outputs)
    known = inputs * fitted
    gram = jnp.matmul(known.T, known, precision="highest")
    gram += _RIDGE * jnp.sum(fitted) * jnp.eye(len(gram))
    wanted = jnp.matmul(known.T, outputs, precision="highest")
    weights = solve(gram, wanted, assume_a="pos")
    errors = jnp.abs(outputs - jnp.matmul(inputs, weights, precision="highest"))
    errors = jnp.where(kept, errors, jnp.nan)
    usual = jnp.nanmedian(errors[newest:], axis=0) + _TINY
    return jnp.nanmean(jnp.log(errors[:newest] / usual + _SMALLEST_LOG))


def deviation(history: Sequence[float], score: float) -> float:
    """How far a score is from the latest ones, in units of their spread.

    The spread is that between quartiles, on which single scores have no effect.

    Args:
      history: earlier scores, oldest first.
      score: the new one.

    Returns:
      |score - median| / (interquartile range / 1.35 + 0.02) for the last `HISTORY`
      scores; NaN if there are fewer than 10.
    """
    if len(history) < _LEAST:
        return float("nan")
    known = np.asarray(history[-HISTORY:])
    first, median, third = np.percentile(known, [25, 50, 75])
    return float(abs(score - median) / ((third - first) / _QUARTILES + _FLOOR))
