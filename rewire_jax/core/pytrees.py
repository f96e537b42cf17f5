"""Pytrees of arrays, stacked on a leading axis."""

from typing import Any

import jax
import jax.numpy as jnp


def count(tree: Any) -> int:
    """Returns how many numbers a pytree of arrays holds."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def tile(tree: Any, copies: int) -> Any:
    """Returns copies of a pytree's arrays, stacked on a new leading axis."""
    return jax.tree.map(lambda x: jnp.tile(x, (copies, *[1] * x.ndim)), tree)


def at(tree: Any, index: jax.Array) -> Any:
    """Returns the entries of a stacked pytree at an index."""
    return jax.tree.map(lambda x: x[index], tree)


def put(tree: Any, index: jax.Array, value: Any) -> Any:
    """Returns a stacked pytree with the entries at an index replaced."""
    return jax.tree.map(lambda x, v: x.at[index].set(v), tree, value)


def learned_place(place: jax.Array, learned: jax.Array) -> jax.Array:
    """Returns `[]`: a task's place or, if it is not learned yet, the latest one's.

    Args:
      place: `[]` int, the task's place.
      learned: `[]` int, how many places are learned; before the first, place 0 counts.
    """
    return jnp.minimum(place, jnp.maximum(learned - 1, 0))
