"""Calls one of several functions, by an index that the whole batch shares."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp


def switch(functions: Sequence[Callable[..., Any]]) -> Callable[..., Any]:
    """Makes a function of one element that calls one of several functions of a batch.

    The result may be vmapped, also several times. The chosen function then runs once,
    on all elements together, and the other functions do not run. If the index is
    vmapped too, the elements run one after the other; `jax.lax.switch` would run every
    function on every element.

    Args:
      functions: every leaf of their arguments and results has a leading batch axis.

    Returns:
      `(index, *arguments) -> result`. The index is `[]` int32. Arguments and result are
      those of the functions, without the batch axis.
    """

    @jax.custom_batching.custom_vmap
    def chosen(index, *arguments):
        return jax.lax.switch(index, functions, *arguments)

    @chosen.def_vmap
    def batched(size, is_batched, index, *arguments):
        def expand(leaf, has_axis):
            return leaf if has_axis else jnp.broadcast_to(leaf, (size, *leaf.shape))

        varied, *others = is_batched
        arguments = jax.tree.map(expand, arguments, tuple(others))
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
