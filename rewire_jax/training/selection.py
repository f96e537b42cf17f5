"""Playing the candidates of a method, for it to choose among them."""

from typing import Any

import jax
import jax.numpy as jnp

from rewire_jax.methods.base import map_own
from rewire_jax.training.rollout import Rollout


def fill(policies: Any, rows: int) -> Any:
    """A member's policies `[candidates]` in so many rows, over and over."""
    return map_own(lambda leaf: leaf[jnp.arange(rows) % len(leaf)], policies)


def judge(
    result: Rollout, valid: jax.Array, spent: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """A member's candidates by their returns, and what it took to know these.

    Args:
      result: `[rows, episodes]`; the first rows are those of the candidates.
      valid: `[candidates]` bool; the others are not counted.
      spent: `[]` int, interactions spent on candidates before.

    Returns:
      Mean returns `[candidates]`, and `spent` with the interactions of these episodes.
    """
    number = len(valid)
    used = result.lengths[:number].sum(axis=1) * valid
    return result.returns[:number].mean(axis=1), spent + used.sum()
