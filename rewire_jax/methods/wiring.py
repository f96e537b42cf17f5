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

from rewire_jax.nn.networks import Linear, affine
from rewire_jax.nn.permutation import permute, permute_rows

Hidden = Sequence[Linear]


class Adapters(NamedTuple):
    """Scores of the alignment permutations.

    Attributes:
      out: `[L, n]`, of P'.
      inp: `[L - 1, n]`, of P'' from the second layer on.
    """

    out: jax.Array
    inp: jax.Array


def spread(orders: jax.Array) -> jax.Array:
    """Evenly spaced scores in [0, 1] that sort into the given orders, `[..., n]`."""
    ranks = jnp.argsort(orders, axis=-1)
    return ranks / max(orders.shape[-1] - 1, 1)


def identity_adapters(depth: int, n: int) -> Adapters:
    """Adapters that move nothing."""
    scores = spread(jnp.arange(n))
    return Adapters(jnp.tile(scores, (depth, 1)), jnp.tile(scores, (depth - 1, 1)))


def permute_outputs(layer: Linear, scores: jax.Array, tau: ArrayLike) -> Linear:
    """The layer whose output is `permute(layer's output, scores, tau)`.

    Both gradients are those of permuting the output, summed over the batch, at
    the cost of a permutation of the weights.
    """
    return Linear(*permute_rows(list(layer), scores, tau))


def wired(layer: Linear, scores: jax.Array, tau: ArrayLike, x: jax.Array) -> jax.Array:
    """A layer's output `[..., n]` for x `[..., inputs]`, in the order of scores `[n]`.

    Eq. 2, before the activation. A large batch is spared by permuting the weights, a
    small one is permuted itself: value and gradients are the same.
    """
    batch, inputs = x.size // x.shape[-1], x.shape[-1]
    if batch < inputs:
        return permute(affine(layer, x), scores, tau)
    return affine(permute_outputs(layer, scores, tau), x)


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


def alignment_loss(
    hidden: Hidden,
    previous: Hidden,
    adapters: Adapters,
    tau: ArrayLike,
    *,
    expanded: bool = False,
) -> jax.Array:
    """L_SP, the squared distance to the adapted previous weights and biases (Eq. 11).

    Args:
      hidden: current layers.
      previous: layers at the end of the previous task.
      adapters: their permutation.
      tau: temperature of the adapters' relaxation.
      expanded: leave out the square of the adapted weights, constant under true
        permutations but not under their relaxation (the authors' code).
    """
    adapted = adapt(previous, adapters, tau)
    if not expanded:
        return squared_distance(hidden, adapted)
    leaves = zip(jax.tree.leaves(hidden), jax.tree.leaves(adapted), strict=True)
    return sum(
        (jnp.sum(now**2 - 2 * now * then) for now, then in leaves), jnp.zeros(())
    )


def squared_distance(hidden: Hidden, others: Hidden) -> jax.Array:
    """Sum of squared differences of all weights and biases."""
    leaves = zip(jax.tree.leaves(hidden), jax.tree.leaves(others), strict=True)
    return sum((jnp.sum((now - then) ** 2) for now, then in leaves), jnp.zeros(()))


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
