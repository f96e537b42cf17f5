"""Wirings: orders of hidden neurons, their cache, and alignment with the weights.

A wiring of L hidden layers of n neurons is an order z `[L, n]`: layer l computes
`activate((weight_l @ x + bias_l)[z_l])` (Eq. 2, 3). Reordering a layer's output is
reordering the rows of its weights, so a wired network is an ordinary MLP.

Adapters describe how the current weights differ from the previous ones by a
permutation: `out_l` (P'_l) of a layer's neurons, `inp_l` (P''_l) of its inputs. The
first layer's inputs are the observation and have none.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from rewire_jax.nn.networks import Linear
from rewire_jax.nn.permutation import permute
from rewire_jax.nn.wired_layers import even_scores, permute_outputs

Hidden = Sequence[Linear]


class Adapters(NamedTuple):
    """Scores of the alignment permutations.

    Attributes:
      out: `[L, n]`, of P'.
      inp: `[L - 1, n]`, of P'' from the second layer on.
    """

    out: jax.Array
    inp: jax.Array


def scores_of(orders: jax.Array) -> jax.Array:
    """Evenly spaced scores in [0, 1] that sort into the given orders, `[..., n]`."""
    ranks = jnp.argsort(orders, axis=-1)
    return ranks / max(orders.shape[-1] - 1, 1)


def identity_adapters(depth: int, n: int) -> Adapters:
    """Adapters that move nothing."""
    scores = even_scores(n)
    return Adapters(jnp.tile(scores, (depth, 1)), jnp.tile(scores, (depth - 1, 1)))


def fold(hidden: Hidden, orders: jax.Array) -> list[Linear]:
    """All layers with their outputs in fixed orders `[L, n]`, an ordinary MLP's."""
    return [Linear(w[z], b[z]) for (w, b), z in zip(hidden, orders, strict=True)]


def adapt(previous: Hidden, adapters: Adapters, tau: ArrayLike) -> list[Linear]:
    """The previous layers seen through the adapters, P' W P''^T and P' b (Eq. 10)."""
    adapted = []
    for index, layer in enumerate(previous):
        weight, bias = permute_outputs(layer, adapters.out[index], tau)
        if index > 0:
            weight = permute(weight, adapters.inp[index - 1], tau)
        adapted.append(Linear(weight, bias))
    return adapted


def refine(orders: jax.Array, adapters: Adapters) -> jax.Array:
    """Cached orders realigned with the current weights (Eq. 12).

    If W_l = P'_l Wprev_l P''_l^T, the layer's inputs must come in the order P''_l.
    So the layer before must end in it: its order becomes P''_{l+1} P_l P'_l^T, of
    which `inverse(p')[z[p'']]` are the indices. No adapter follows the last layer.

    Args:
      orders: `[..., L, n]` orders for the previous weights.
      adapters: learned adapters.

    Returns:
      `[..., L, n]` orders for the current weights.
    """
    undo = jnp.argsort(jnp.argsort(adapters.out, axis=-1), axis=-1)
    follow = jnp.argsort(adapters.inp, axis=-1)
    last = jnp.arange(orders.shape[-1])[None]
    following = jnp.concatenate([follow, last]).astype(orders.dtype)
    shifted = jnp.take_along_axis(orders, jnp.broadcast_to(following, orders.shape), -1)
    refined = jnp.take_along_axis(jnp.broadcast_to(undo, orders.shape), shifted, -1)
    return refined.astype(orders.dtype)
