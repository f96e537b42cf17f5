"""The permutation operator: hard orders forward, SoftSort gradients backward."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp


@jax.custom_vjp
def permute(x: jax.Array, scores: jax.Array, tau: jax.typing.ArrayLike) -> jax.Array:
    """Reorders the last axis of `x` by ascending `scores`, learnably (Eq. 3, 4).

    The value is `x[..., argsort(scores)]`; ties keep their place. The gradient in
    `x` is that of this gather. The gradient in `scores` is that of the straight-
    through form `x @ (P + Q - stop_gradient(Q)).T` with P the hard permutation and
    Q[i, j] = softmax_j(-|sort(scores)_i - scores_j| / tau), without building P.

    Args:
      x: `[..., n]`, any floating dtype.
      scores: `[n]`.
      tau: `[]`, temperature of the relaxation, positive. Gets no gradient.

    Returns:
      `[..., n]`, in the dtype of `x`.
    """
    return jnp.take(x, jnp.argsort(scores), axis=-1)


def _forward(x, scores, tau):
    order = jnp.argsort(scores)
    permuted = jnp.take(x, order, axis=-1)
    return permuted, (permuted, order, scores, tau)


def _backward(residuals, gradient):
    permuted, order, scores, tau = residuals
    n = order.shape[0]
    wide = jnp.promote_types(permuted.dtype, jnp.float32)
    outer = jnp.einsum(
        "bi,bj->ij",
        gradient.reshape(-1, n).astype(wide),
        permuted.reshape(-1, n).astype(wide),
    )
    inverse = _invert(order)
    return (
        jnp.take(gradient, inverse, axis=-1).astype(permuted.dtype),
        _score_gradient(outer, order, inverse, scores, tau),
        jnp.zeros_like(tau),
    )


permute.defvjp(_forward, _backward)


@jax.custom_vjp
def permute_rows(
    arrays: Sequence[jax.Array], scores: jax.Array, tau: jax.typing.ArrayLike
) -> list[jax.Array]:
    """`permute` on the first axis of several arrays `[n, ...]` at once.

    Reordering the rows of a layer's weights reorders its output, so this gives the
    same gradients as `permute` on the output, whatever the size of the batch.
    """
    order = jnp.argsort(scores)
    return [jnp.take(x, order, axis=0) for x in arrays]


def _rows_forward(arrays, scores, tau):
    order = jnp.argsort(scores)
    permuted = [jnp.take(x, order, axis=0) for x in arrays]
    return permuted, (permuted, order, scores, tau)


def _rows_backward(residuals, gradients):
    permuted, order, scores, tau = residuals
    n = order.shape[0]
    # Contracted as they lie: a transposed operand would be copied under vmap.
    outer = sum(
        jnp.einsum("ik,jk->ij", g.reshape(n, -1), x.reshape(n, -1))
        for g, x in zip(gradients, permuted, strict=True)
    )
    inverse = _invert(order)
    return (
        [jnp.take(g, inverse, axis=0) for g in gradients],
        _score_gradient(outer, order, inverse, scores, tau),
        jnp.zeros_like(tau),
    )


permute_rows.defvjp(_rows_forward, _rows_backward)


def _invert(order):
    places = jnp.arange(order.shape[0], dtype=order.dtype)
    return jnp.zeros_like(order).at[order].set(places, unique_indices=True)


def _score_gradient(outer, order, inverse, scores, tau):
    """Gradient in the scores, given `outer[i, j] = <gradient_i, permuted_j>`.

    In the sorted basis both axes of the relaxation follow the sorted scores, so no
    n x n array is ever gathered; only the n results go back to their places.
    """
    ordered = scores[order].astype(outer.dtype)
    tau = jnp.asarray(tau, outer.dtype)
    difference = ordered[:, None] - ordered[None, :]
    # The diagonal is 1 and nothing is larger: a softmax without its maximum.
    near = jnp.exp(-jnp.abs(difference) / tau)
    weight = 1 / jnp.sum(near, axis=1)
    both = near * outer
    centre = jnp.sum(both, axis=1) * weight
    # At ties the sign is +1, JAX's own derivative of abs at 0.
    rate = (weight / tau)[:, None]
    slope = jnp.where(difference >= 0, rate, -rate) * (both - near * centre[:, None])
    in_sorted = jnp.sum(slope, axis=0) - jnp.sum(slope, axis=1)
    return in_sorted[inverse].astype(scores.dtype)
