"""The permutation operator: hard orders forward, SoftSort gradients backward."""

import math
from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.nn.softsort_vjp import score_gradient

_BLOCK = {"cpu": 32, "other": 256}
"""Least places in a block of the backward pass, by device.

On "cpu" the fastest for 256 to 1024 scores and 18 to 512 columns, on two cores: to
measure again, time `score_gradient` with other blocks in a compiled loop. On "other"
devices a choice, not measured: one large product rather than many small kernels.
"""


def permute(x: jax.Array, scores: jax.Array, tau: jax.typing.ArrayLike) -> jax.Array:
    """Reorders the last axis of `x` by ascending `scores`, learnably (Eq. 3, 4).

    The value is `x[..., argsort(scores)]`; ties keep their place. The gradient in
    `x` is that of this gather. The gradient in `scores` is that of the straight-
    through form `x @ (P + Q - stop_gradient(Q)).T` with P the hard permutation and
    `Q[i, j] = softmax_j(-|sort(scores)_i - scores_j| / tau)`, without building either.

    Args:
      x: `[..., n]`, any floating dtype.
      scores: `[n]`.
      tau: `[]`, temperature of the relaxation, positive. Gets no gradient.

    Returns:
      `[..., n]`, in the dtype of `x`.

    Raises:
      AssertionError: the shapes do not fit, or an array is not of floats.
      ValueError: tau is known and not a positive, finite 32-bit float.
    """
    chex.assert_rank([scores, tau], [1, 0])
    known = not isinstance(tau, jax.core.Tracer)
    if known and not 0 < np.asarray(tau, np.float32) < np.inf:
        raise ValueError(f"tau must be positive and finite in 32 bits, not {tau}")
    chex.assert_axis_dimension(x, -1, scores.shape[0])
    chex.assert_type([x, scores], float)
    return _permute(x, scores, tau)


@jax.custom_vjp
def _permute(x, scores, tau):
    return _take_last(x, _order(scores))


def _forward(x, scores, tau):
    order = _order(scores)
    permuted = _take_last(x, order)
    return permuted, (permuted, order, scores, tau)


def _backward(residuals, gradient):
    permuted, order, scores, tau = residuals
    flat, values = (x.reshape(-1, order.shape[0]) for x in (gradient, permuted))
    return (
        _take_last(gradient, _invert(order)),
        _score_gradient([flat], [values], order, scores, tau, axis=1),
        jnp.zeros_like(tau),
    )


_permute.defvjp(_forward, _backward)


@jax.custom_vjp
def permute_rows(
    arrays: Sequence[jax.Array], scores: jax.Array, tau: jax.typing.ArrayLike
) -> list[jax.Array]:
    """`permute` on the first axis of several arrays `[n, ...]` at once.

    Reordering the rows of a layer's weights reorders its output, so this gives the
    same gradients as `permute` on the output, whatever the size of the batch.
    """
    order = _order(scores)
    return [_take(x, order) for x in arrays]


def _rows_forward(arrays, scores, tau):
    order = _order(scores)
    permuted = [_take(x, order) for x in arrays]
    return permuted, (permuted, order, scores, tau)


def _rows_backward(residuals, gradients):
    permuted, order, scores, tau = residuals
    return (
        # By a gather, XLA would do it twice within the optimiser, in both moments.
        [_put(g, order) for g in gradients],
        _score_gradient(gradients, permuted, order, scores, tau),
        jnp.zeros_like(tau),
    )


permute_rows.defvjp(_rows_forward, _rows_backward)


def _order(scores):
    """`argsort(scores)`, which takes three times as long on a CPU.

    There, XLA sorts single integers much faster than pairs. So the place is
    in the lower half of a sorted word, and first the lower, then the upper half
    of the score's bits in the other. Unlike counts of the smaller ones, a sort is never
    fused with what makes the scores, which would be computed again for each comparison.
    """
    n, half, sign = scores.shape[0], np.uint32(0xFFFF), np.uint32(1 << 31)
    if jax.default_backend() != "cpu" or scores.dtype != jnp.float32 or n > half:
        return jnp.argsort(scores)
    bits = jax.lax.bitcast_convert_type(scores + 0.0, jnp.uint32)  # no negative zeros
    # Words in the order of the numbers.
    bits = jnp.where(bits >= sign, ~bits, bits | sign)
    bits = jnp.where(jnp.isnan(scores), ~np.uint32(0), bits)  # last, in their order
    place = jnp.arange(n, dtype=jnp.uint32)
    first = jnp.sort((bits << 16) | place) & half
    second = jnp.sort((_take(bits, first) & ~half) | place) & half
    return _take(first, second).astype(jnp.int32)


def _take(x, order):
    return jnp.asarray(x).at[order].get(mode="promise_in_bounds", unique_indices=True)


def _take_last(x, order):
    """`x[..., order]`, which XLA would make transposed, at thrice the time on a CPU."""
    order = jnp.broadcast_to(order, x.shape)
    return jnp.take_along_axis(x, order, -1, mode="promise_in_bounds")


def _put(x, order):
    """The array whose rows `order` are those of x."""
    zeros = jnp.zeros_like(x)
    return zeros.at[order].set(x, mode="promise_in_bounds", unique_indices=True)


def _invert(order):
    return _put(jnp.arange(order.shape[0], dtype=order.dtype), order)


def _score_gradient(gradients, permuted, order, scores, tau, axis=0):
    """Gradient in the scores, from the sorted ones: only n results are moved."""
    wide = jnp.promote_types(permuted[0].dtype, jnp.float32)
    in_sorted = score_gradient(
        [g.astype(wide) for g in gradients],
        [x.astype(wide) for x in permuted],
        jnp.asarray(scores)[order].astype(wide),
        jnp.asarray(tau, wide),
        _block(scores.shape[0]),
        axis,
    )
    return in_sorted[_invert(order)].astype(scores.dtype)


def _block(n):
    device = "cpu" if jax.default_backend() == "cpu" else "other"
    return max(_BLOCK[device], math.isqrt(n))
