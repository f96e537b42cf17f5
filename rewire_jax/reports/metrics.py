"""Continual-learning metrics on plain arrays of scores.

A matrix is `[..., stages, tasks]`: entry `[s, t]` is the score on task `t` after
training on task `s`, so a whole sequence of T tasks gives `[..., T, T]`. The measures
are those of the paper's section 4.1 and appendix A.3, and of Continual World (Wołczyk
et al. 2021, arXiv 2105.10919), whose forgetting has the other sign.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Scores = NDArray[np.float64]


def final(matrix: ArrayLike) -> Scores:
    """Score of each task after the last stage.

    Args:
        matrix: `[..., stages, tasks]`.

    Returns:
        `[..., tasks]`.
    """
    return np.asarray(matrix, np.float64)[..., -1, :]


def after_own_training(matrix: ArrayLike) -> Scores:
    """Score of each task right after it was trained: the diagonal.

    Args:
        matrix: `[..., tasks, tasks]`.

    Returns:
        `[..., tasks]`.

    Raises:
        ValueError: if there are not as many stages as tasks.
    """
    scores = np.asarray(matrix, np.float64)
    stages, tasks = scores.shape[-2:]
    if stages != tasks:
        raise ValueError(f"{stages} stages for {tasks} tasks: they must be as many")
    return np.diagonal(scores, axis1=-2, axis2=-1)


def forgetting(matrix: ArrayLike) -> Scores:
    """Score at the end minus the score right after own training, for each task.

    Negative where a task was forgotten, 0 for the last task by definition.

    Args:
        matrix: `[..., tasks, tasks]`.

    Returns:
        `[..., tasks]`.
    """
    return final(matrix) - after_own_training(matrix)


def performance(matrix: ArrayLike) -> Scores:
    """Score after the last stage, averaged over tasks.

    Args:
        matrix: `[..., stages, tasks]`.

    Returns:
        `[...]`.
    """
    return np.asarray(final(matrix).mean(axis=-1))


def normalise(matrix: ArrayLike, reference: ArrayLike) -> Scores:
    """Scores divided by the reference's average over the tasks.

    All tasks share one divisor, so that a normalised performance is a ratio of
    averages. A ratio for each task would mean nothing where the reference's return on
    that task is negative, and be all noise where it is close to 0.

    Args:
        matrix: `[..., tasks]`, a matrix or what was taken from one.
        reference: `[tasks]`, the score of each task at the end; SAC-N's on Brax.

    Returns:
        `[..., tasks]`.

    Raises:
        ValueError: if the reference's average is not above 0.
    """
    scale = np.mean(np.asarray(reference, np.float64))
    if not scale > 0:
        raise ValueError(f"cannot normalise with an average of {scale:g}")
    return np.asarray(matrix, np.float64) / scale


def forward_transfer(matrix: ArrayLike, reference: ArrayLike) -> Scores:
    """Score right after own training minus the reference's there, for each task.

    Positive where what was learned before was of use.

    Args:
        matrix: `[..., tasks, tasks]`, normalised where the reference is.
        reference: `[..., tasks]`, the score right after own training of a method that
            learns every task from scratch; SAC-N's on Brax.

    Returns:
        `[..., tasks]`.
    """
    return after_own_training(matrix) - np.asarray(reference, np.float64)


def area(interactions: ArrayLike, scores: ArrayLike) -> Scores:
    """Mean score over a task's training, the area under its curve.

    Each score is what was seen since the last report, so it is weighted by the
    interactions since then. Reports that saw nothing are left out with theirs.

    Args:
        interactions: `[points]`, increasing from above 0, within the task.
        scores: `[..., points]`, NaN where nothing was seen.

    Returns:
        `[...]`, NaN where no report saw anything.
    """
    scores = np.asarray(scores, np.float64)
    there = ~np.isnan(scores)
    since = np.diff(np.asarray(interactions, np.float64), prepend=0.0)
    weights = np.sum(since * there, axis=-1)
    total = np.sum(since * np.where(there, scores, 0.0), axis=-1)
    return np.where(weights > 0, total / np.where(weights > 0, weights, 1.0), np.nan)


def area_transfer(areas: ArrayLike, alone: ArrayLike) -> Scores:
    """Forward transfer of Continual World, for each task.

    (AUC - AUC_b) / (1 - AUC_b) for success rates, AUC being `area`: 1 where the task is
    solved from the first episode, 0 where nothing learned before was of use.

    Args:
        areas: `[..., tasks]`, in 0 to 1.
        alone: `[tasks]`, AUC_b, of learning the task alone from scratch.

    Returns:
        `[..., tasks]`, NaN where AUC_b is 1, which nothing can exceed.
    """
    areas, alone = np.asarray(areas, np.float64), np.asarray(alone, np.float64)
    room = 1.0 - alone
    possible = room > 0
    return np.where(possible, (areas - alone) / np.where(possible, room, 1.0), np.nan)
