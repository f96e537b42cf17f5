"""The gradient of SoftSort in its scores, without n x n matrices.

The relaxation of an order is Q[i, j] = softmax_j(-|s_i - s_j| / tau), with s the
sorted scores (Eq. 4). Cut into blocks of neighbours, exp(-|s_i - s_j| / tau) is a
small matrix within each block. Between blocks it is a product of three decays: from j
to the edge of its block, from there to the edge of i's block, and from there to i. So
one vector stands for all that a block gets from earlier ones, another for later ones,
and everything is a matrix product. No exponent is positive, whatever scores and tau.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp


def score_gradient(
    gradients: Sequence[jax.Array],
    permuted: Sequence[jax.Array],
    ordered: jax.Array,
    tau: jax.Array,
    block: int,
    axis: int = 0,
) -> jax.Array:
    """Gradient of sum(Q * A) in the sorted scores, A[i, j] = <gradient_i, permuted_j>.

    Takes O(n m block + (n / block)² m) steps and O(n (m + block) + (n / block)²)
    memory.

    Args:
      gradients: arrays `[n, m]`, of the loss in each of the permuted ones.
      permuted: arrays `[n, m]`, their rows in the order of the scores.
      ordered: `[n]`, ascending.
      tau: `[]`, temperature.
      block: places in a block; if n or more, there is one with all.
      axis: 1 for arrays `[m, n]`: to transpose large ones would take XLA longer than
        all else.

    Returns:
      `[n]`.
    """
    n = ordered.shape[0]
    blocks = -(-n // block)
    block = -(-n // blocks)
    surplus = blocks * block - n

    def cut(x, axis=0, mode="constant"):
        if surplus:
            widths = [(0, 0)] * x.ndim
            widths[axis] = (0, surplus)
            x = jnp.pad(x, widths, mode)
        if axis == 0:
            return x.reshape(blocks, block, -1)
        return x.reshape(-1, blocks, block).swapaxes(0, 1)

    pairs = [
        (cut(g, axis), cut(x, axis)) for g, x in zip(gradients, permuted, strict=True)
    ]
    i, j = ("bim", "bjm") if axis == 0 else ("bmi", "bmj")
    s, real = cut(ordered, mode="edge"), cut(jnp.ones_like(ordered))
    difference = s - s.mT
    near = jnp.exp(-jnp.abs(difference) / tau) * real.mT
    # At ties the sign is +1, JAX's own derivative of abs at 0.
    signed = jnp.where(difference >= 0, near, -near)
    product = sum(jnp.einsum(f"{i},{j}->bij", g, x) for g, x in pairs)
    rows, columns = _sides(s[..., 0], tau)

    ones = _far(rows, real).mT
    inner = _meet(rows, pairs, i)
    lift = jnp.abs(rows.lift[..., :2])
    norm = jnp.sum(near, 2) + jnp.sum(lift * ones[..., :2], 2)
    # The product with ones is a sum, and quicker on a CPU.
    total = (near * product) @ jnp.ones_like(s[0, :, 0])
    centre = ((total + jnp.sum(lift * inner[..., :2], 2)) / norm)[..., None]
    rate = (1 / (norm * tau))[..., None]
    slope = rate * signed * (product - centre)
    inner = rows.lift * (inner - centre * ones)
    as_row = jnp.sum(slope, 2) + rate[..., 0] * jnp.sum(inner, 2)

    columns = columns._replace(decay=columns.decay * rate.mT)
    inner = _meet(columns, [(x, g) for g, x in pairs], i)
    inner = columns.lift * (inner - _far(columns, centre).mT)
    as_column = jnp.sum(slope, 1) + jnp.sum(inner, 2)
    return (as_column - as_row).reshape(-1)[:n]


class _Side(NamedTuple):
    """Signed sums over other blocks: of earlier, of later and of tied later places.

    The order of the axes is the one that is quickest on a CPU, by a third.

    Attributes:
      decay: `[blocks, 3, block]`, from a place to the edge of its block.
      gap: `[3, blocks, blocks]`, from there to the edge of another.
      lift: `[blocks, block, 3]`, from there to a place, with the sign.
    """

    decay: jax.Array
    gap: jax.Array
    lift: jax.Array


def _sides(s, tau):
    """What rows see of columns and, mirrored, columns of rows."""
    first, last = s[:, :1], s[:, -1:]
    to_first, to_last = jnp.exp((first - s) / tau), jnp.exp((s - last) / tau)
    is_first, is_last = (s == first).astype(s.dtype), (s == last).astype(s.dtype)
    gap = jnp.tril(jnp.exp(-jnp.abs(first - last.T) / tau), -1)
    tie = jnp.triu((last == first.T).astype(s.dtype), 1)
    # A single block gets nothing from others.
    kinds = slice(3 if s.shape[0] > 1 else 0)

    def side(decay, gap, lift):
        decay, gap, lift = map(jnp.stack, (decay, gap, lift), (1, 0, 2))
        return _Side(decay[:, kinds], gap[kinds], lift[..., kinds])

    # Tied places count among the later ones with the wrong sign, hence the 2.
    return side(
        (to_last, to_first, is_first),
        (gap, gap.T, tie),
        (to_first, -to_last, 2 * is_last),
    ), side(
        (to_first, to_last, is_last),
        (gap.T, gap, tie.T),
        (to_last, -to_first, 2 * is_first),
    )


def _far(side, x, axes="bim"):
    """`[blocks, 3, m]`: what reaches each block from the others of x."""
    edge = jnp.einsum(f"bti,{axes}->btm", side.decay, x)
    return jnp.einsum("tab,btm->atm", side.gap, edge)


def _meet(side, pairs, axes):
    """`[blocks, block, 3]`: products of places with what reaches their block."""
    return sum(
        jnp.einsum(f"btm,{axes}->bti", _far(side, there, axes), here).mT
        for here, there in pairs
    )
