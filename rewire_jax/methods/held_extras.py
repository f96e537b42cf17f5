"""Extras that environments hold for several steps."""

import jax
import jax.numpy as jnp


def held(
    extras: jax.Array | None, drawn: jax.Array, steps: jax.Array, every: int
) -> jax.Array:
    """Returns `[envs, ...]`: new extras in each `every`-th step, else those before.

    Args:
      extras: those of the previous step; None at a task's start, where all are new.
      drawn: new ones.
      steps: `[envs]` int, steps made in the running episodes.
      every: steps between two draws; an episode's first step draws, too.
    """
    if extras is None:
        return drawn
    due = steps % every == 0
    return jnp.where(due.reshape(-1, *[1] * (drawn.ndim - 1)), drawn, extras)
