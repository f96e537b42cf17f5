"""The order of configurations by the scores of their seeds."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def rank(scores: ArrayLike) -> NDArray[np.intp]:
    """Sorts configurations, the best first.

    Fewer diverged seeds come first, then the higher mean over the other seeds. Equal
    configurations keep their order.

    Args:
        scores: `[configurations, seeds]`, NaN for a seed that diverged.

    Returns:
        Indices of configurations, `[configurations]`.
    """
    scores = np.asarray(scores, np.float64)
    lost = np.isnan(scores).sum(axis=1)
    left = scores.shape[1] - lost
    # If all seeds of a configuration diverged, its mean is 0.
    means = np.nansum(scores, axis=1) / np.maximum(left, 1)
    return np.lexsort((-means, lost))
