"""Evaluation of a method's candidates, so that the method can choose one."""

from typing import Any

import jax
import jax.numpy as jnp

from rewire_jax.methods.shared import map_own
from rewire_jax.training.rollout import Rollout


def fill(policies: Any, rows: int) -> Any:
    """Repeats a member's policies `[candidates]` until they fill `rows` rows."""
    return map_own(lambda leaf: leaf[jnp.arange(rows) % len(leaf)], policies)


def judge(
    result: Rollout, valid: jax.Array, spent: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Computes the mean returns of a member's candidates and counts their steps.

    Args:
      result: `[rows, episodes]`; the first rows belong to the candidates.
      valid: `[candidates]` bool; steps of other candidates are not counted.
      spent: `[]` int, interactions spent on candidates before.

    Returns:
      Mean returns `[candidates]`, and `spent` with the interactions of these episodes.
    """
    number = len(valid)
    used = result.lengths[:number].sum(axis=1) * valid
    return result.returns[:number].mean(axis=1), spent + used.sum()
