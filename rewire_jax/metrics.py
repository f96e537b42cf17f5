"""Continual-learning metrics on plain arrays of scores.

A matrix is `[..., stages, tasks]`: entry `[s, t]` is the score on task `t` after
training on task `s`, so a whole sequence of T tasks gives `[..., T, T]`.
Definitions: FACTS.md, section 4, "Metrics".
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
