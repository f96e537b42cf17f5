"""The permutation operator: hard orders forward, SoftSort gradients backward."""

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
    tau = jnp.asarray(tau)  # A constant comes back from jit as a plain number.
    n = order.shape[0]
    wide = jnp.promote_types(permuted.dtype, jnp.float32)
    # In the sorted basis both axes of the relaxation follow the sorted scores, so
    # no n x n array is ever gathered; only the n results go back to their places.
    outer = jnp.einsum(
        "bi,bj->ij",
        gradient.reshape(-1, n).astype(wide),
        permuted.reshape(-1, n).astype(wide),
    )
    sorted_scores = scores[order].astype(wide)
    difference = sorted_scores[:, None] - sorted_scores[None, :]
    soft = jax.nn.softmax(-jnp.abs(difference) / tau.astype(wide), axis=-1)
    logits = soft * (outer - jnp.sum(soft * outer, axis=-1, keepdims=True))
    # At ties the sign is +1, JAX's own derivative of abs at 0.
    slope = jnp.where(difference >= 0, logits, -logits) / tau.astype(wide)
    in_sorted = jnp.sum(slope, axis=0) - jnp.sum(slope, axis=1)
    inverse = jnp.argsort(order)
    return (
        jnp.take(gradient, inverse, axis=-1).astype(permuted.dtype),
        in_sorted[inverse].astype(scores.dtype),
        jnp.zeros_like(tau),
    )


permute.defvjp(_forward, _backward)
