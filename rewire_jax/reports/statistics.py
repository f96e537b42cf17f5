"""Statistics of Agarwal et al. (NeurIPS 2021) on plain arrays `[seeds, tasks]`.

They are those of the package rliable: a test compares them with its numbers. The
interquartile mean is in `metrics`. Intervals are percentiles of a stratified bootstrap:
for each task, seeds are drawn anew, with replacement.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rewire_jax.reports.metrics import interquartile_mean

Array = NDArray[np.float64]


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> Array:
    """Share of scores above each threshold, over all seeds and tasks.

    Args:
        scores: `[..., seeds, tasks]`.
        thresholds: `[n]`.

    Returns:
        `[..., n]`.
    """
    scores = np.asarray(scores, np.float64)
    flat = np.sort(scores.reshape(*scores.shape[:-2], -1), axis=-1)
    shares = [
        np.mean(flat > threshold, axis=-1)
        for threshold in np.asarray(thresholds, np.float64)
    ]
    return np.stack(shares, axis=-1)


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> Array:
    """Probability that a score of X is above one of Y on the same task.

    P(X > Y) + ½ P(X = Y) over all pairs of seeds, averaged over tasks.

    Args:
        x: `[..., seeds, tasks]`.
        y: `[..., seeds, tasks]`, with as many tasks.

    Returns:
        `[...]`.
    """
    left = np.asarray(x, np.float64)[..., :, None, :]
    right = np.asarray(y, np.float64)[..., None, :, :]
    better = (left > right) + 0.5 * (left == right)
    return np.asarray(better.mean(axis=(-3, -2, -1)))


def normalised_iqm(scores: ArrayLike, reference: ArrayLike) -> Array:
    """Interquartile mean of scores divided by the mean of the reference's.

    Args:
        scores: `[..., seeds, tasks]`.
        reference: `[..., seeds, tasks]`, SAC-N's on Brax.

    Returns:
        `[...]`.
    """
    scores = np.asarray(scores, np.float64)
    middle = interquartile_mean(scores.reshape(*scores.shape[:-2], -1))
    return middle / np.asarray(reference, np.float64).mean(axis=(-2, -1))


def interval(
    of: Callable[..., Array],
    *samples: ArrayLike,
    level: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> Array | None:
    """Percentile interval of a value of one or more samples, each drawn anew.

    Args:
        of: the value, from samples `[draws, seeds, tasks]` to `[draws, ...]`.
        samples: `[seeds, tasks]` each.
        level: how probable the interval is to hold the value.
        resamples: how often all is drawn.
        seed: of the drawing: the same samples always give the same interval.

    Returns:
        `[2, ...]`, the two ends; None if a sample has fewer than two seeds.
    """
    arrays = [np.asarray(sample, np.float64) for sample in samples]
    if any(len(array) < 2 for array in arrays):
        return None
    generator = np.random.default_rng(seed)
    values = []
    for _ in range(0, resamples, 1_000):  # All at once would take much memory.
        drawn = []
        for array in arrays:
            places = generator.integers(len(array), size=(1_000, *array.shape))
            drawn.append(np.take_along_axis(array[None], places, axis=1))
        values.append(of(*drawn))
    tails = [50 * (1 - level), 50 * (1 + level)]
    return np.asarray(np.percentile(np.concatenate(values), tails, axis=0))
