"""The order of configurations by what their seeds scored."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def rank(scores: ArrayLike) -> NDArray[np.intp]:
    """Configurations, the best first.

    Those with fewer diverged seeds stand before the others, among them those with a
    higher mean over the seeds that are left; what is still equal stays in its order.

    Args:
        scores: `[configurations, seeds]`, NaN for a seed that diverged.

    Returns:
        Indices of configurations, `[configurations]`.
    """
    scores = np.asarray(scores, np.float64)
    lost = np.isnan(scores).sum(axis=1)
    left = scores.shape[1] - lost
    # Where no seed is left there is nothing to compare: the order says no more.
    means = np.nansum(scores, axis=1) / np.maximum(left, 1)
    return np.lexsort((-means, lost))
