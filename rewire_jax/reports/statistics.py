"""Statistics over seeds and tasks, on plain arrays `[..., seeds, tasks]`.

They are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of the
Statistical Precipice" (NeurIPS 2021), and of its package rliable: a test compares them
with rliable's numbers. Leading axes hold resamples.
"""

from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from rewire_jax.reports.spread import Interval

Array = NDArray[np.float64]


def interquartile_mean(scores: ArrayLike) -> Array:
    """Mean of the middle half: a quarter, rounded down, is cut from either end.

    Args:
        scores: `[..., seeds, tasks]`.

    Returns:
        `[...]`, NaN where a score is.
    """
    return np.asarray(scipy.stats.trim_mean(_flat(scores), 0.25, axis=-1))


def normalised_iqm(scores: ArrayLike, reference: ArrayLike) -> Array:
    """Interquartile mean of scores, divided by the mean of the reference's.

    Args:
        scores: `[..., seeds, tasks]`.
        reference: `[..., seeds, tasks]`, SAC-N's on Brax.

    Returns:
        `[...]`.
    """
    return interquartile_mean(scores) / mean(reference)


def mean(scores: ArrayLike) -> Array:
    """Mean over seeds and tasks.

    Args:
        scores: `[..., seeds, tasks]`.

    Returns:
        `[...]`.
    """
    return np.asarray(_flat(scores).mean(axis=-1))


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> Array:
    """Share of scores above each threshold, over all seeds and tasks.

    Args:
        scores: `[..., seeds, tasks]`.
        thresholds: `[n]`.

    Returns:
        `[..., n]`.
    """
    flat = _flat(scores)
    shares = [(flat > each).mean(axis=-1) for each in np.asarray(thresholds)]
    return np.stack(shares, axis=-1)


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> Array:
    """Probability that a score of X is above one of Y on the same task.

    P(X > Y) + ½ P(X = Y) over all pairs of seeds, averaged over tasks.

    Args:
        x: `[..., seeds, tasks]`.
        y: `[..., seeds, tasks]`, of as many tasks.

    Returns:
        `[...]`.
    """
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    better = []
    for task in range(x.shape[-1]):  # All tasks at once would need much memory.
        difference = x[..., :, None, task] - y[..., None, :, task]
        better.append((0.5 + 0.5 * np.sign(difference)).mean(axis=(-2, -1)))
    return np.asarray(np.mean(better, axis=0))


def stratified_bootstrap(
    of: Callable[..., Array],
    *samples: ArrayLike,
    level: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> Array | None:
    """Percentile interval of a value of one or more samples.

    Each task of each sample is a stratum: its seeds are drawn anew, with replacement,
    apart from those of the others.

    Args:
        of: the value, from samples `[resamples, seeds, tasks]` to `[resamples, ...]`.
        samples: `[seeds, tasks]` each; numbers of seeds may differ. One that is given
            twice, as the same array, is drawn once.
        level: how probable the interval is to hold the value.
        resamples: how often all is drawn.
        seed: of the drawing: the same samples always give the same interval.

    Returns:
        `[2, ...]`, its ends; None if a sample has fewer than two seeds, which say
        nothing of the spread.
    """
    unique = list({id(sample): sample for sample in samples}.values())
    arrays = [np.asarray(sample, np.float64) for sample in unique]
    if any(len(array) < 2 for array in arrays):
        return None
    ends = np.cumsum([array.shape[1] for array in arrays])

    def statistic(*strata: Array, axis: int) -> Array:
        # scipy hands over `[resamples, seeds]`, and wants resamples last.
        starts = (0, *ends[:-1])
        drawn = {
            id(sample): np.stack(strata[start:end], axis=axis)
            for sample, start, end in zip(unique, starts, ends, strict=True)
        }
        return np.moveaxis(of(*(drawn[id(sample)] for sample in samples)), 0, -1)

    interval = scipy.stats.bootstrap(
        tuple(stratum for array in arrays for stratum in array.T),
        statistic,
        vectorized=True,
        n_resamples=resamples,
        confidence_level=level,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return np.array([interval.low, interval.high])


def estimate(of: Callable[..., Array], *samples: ArrayLike) -> Interval:
    """A value of one or more samples with its interval, see `stratified_bootstrap`.

    Args:
        of: the value, from samples `[..., seeds, tasks]` to `[...]`.
        samples: `[seeds, tasks]` each.

    Returns:
        Without ends where there is no interval, empty where a sample is.
    """
    if not all(map(np.size, samples)):
        return Interval(None, None, None)
    ends = stratified_bootstrap(of, *samples)
    low, high = (None, None) if ends is None else map(float, ends)
    return Interval(float(of(*samples)), low, high)


def _flat(scores: ArrayLike) -> Array:
    scores = np.asarray(scores, np.float64)
    return scores.reshape(*scores.shape[:-2], -1)
