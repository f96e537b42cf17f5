"""Successive halving: which of several policies suits a task, by their returns."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from rewire_jax.methods.shared import Shared

Array = NDArray[Any]
Play = Callable[[Array, Array, int], Array]
"""`(candidates [..., k], playing [..., k] bool, round) -> returns [..., k]`; returns of
candidates that are not playing do not matter."""


def choose(play: Play, candidates: Array, count: Array) -> Array:
    """Chooses a candidate by successive halving.

    In each round, every remaining candidate plays, and the worse half by the sum of all
    returns so far leaves. Of an odd number, the larger half remains. NaN is the worst
    return, and of equal candidates the first is the better one. A single candidate
    plays nothing.

    Args:
      play: plays a round.
      candidates: `[..., k]` int.
      count: `[...]` int from 1 to k; only the first `count` take part.

    Returns:
      `[...]`, the chosen candidates.
    """
    total = np.zeros(candidates.shape)
    round_ = 0
    while (width := candidates.shape[-1]) > 1:
        remaining = np.arange(width) < count[..., None]
        returns = play(candidates, remaining & (count[..., None] > 1), round_)
        total = total + np.where(np.isnan(returns), -np.inf, returns)
        order = np.argsort(np.where(remaining, -total, np.inf), axis=-1, stable=True)
        order = order[..., : -(-width // 2)]
        candidates = np.take_along_axis(candidates, order, axis=-1)
        total = np.take_along_axis(total, order, axis=-1)
        count = -(-count // 2)
        round_ += 1
    return candidates[..., 0]


def first_equal(policies: Sequence[Any]) -> list[int]:
    """For each policy of a member, the first one that is equal in all its arrays.

    `Shared` parts are not compared, because all of them have these in common.
    """
    seen: dict[bytes, int] = {}
    return [seen.setdefault(_own(each), n) for n, each in enumerate(policies)]


def _own(policy: Any) -> bytes:
    leaves = jax.tree.leaves(policy, is_leaf=lambda x: isinstance(x, Shared))
    own = [np.asarray(leaf) for leaf in leaves if not isinstance(leaf, Shared)]
    return b"".join(leaf.tobytes() for leaf in own)
