"""One of several functions, chosen by an index that a batch shares."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp


def switch(functions: Sequence[Callable[..., Any]]) -> Callable[..., Any]:
    """Chooses one of several functions of a batch, for an element that is vmapped.

    However deep the vmaps are nested, the chosen function runs once, on all elements
    together, and the others do not run. Where the index itself is vmapped its values
    take turns; `jax.lax.switch` would run every function on every element.

    Args:
      functions: every leaf of their arguments and results has one leading axis.

    Returns:
      `(index, *arguments) -> result`: the index is `[]` int32, the rest are as in the
      functions but without that axis.
    """

    @jax.custom_batching.custom_vmap
    def chosen(index, *arguments):
        return jax.lax.switch(index, functions, *arguments)

    @chosen.def_vmap
    def batched(size, is_batched, index, *arguments):
        def spread(leaf, has_axis):
            return leaf if has_axis else jnp.broadcast_to(leaf, (size, *leaf.shape))

        varied, *others = is_batched
        arguments = jax.tree.map(spread, arguments, tuple(others))
        if varied:
            result = jax.lax.map(lambda turn: chosen(*turn), (index, *arguments))
        else:
            flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), arguments)
            result = jax.tree.map(
                lambda x: x.reshape(size, -1, *x.shape[1:]), chosen(index, *flat)
            )
        return result, jax.tree.map(lambda _: True, result)

    def single(index, *arguments):
        arguments = jax.tree.map(lambda x: x[None], arguments)
        return jax.tree.map(lambda x: x[0], chosen(index, *arguments))

    return single
