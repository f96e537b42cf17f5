"""The permutations that align weights best, by solving assignment problems.

The squared distance of Eq. 11, ||W - P' V P''^T||² + ||b - P' c||², falls with the
products of the entries that meet. So for a fixed P'' the best P' is a linear assignment
of the rows of V to those of W, and for a fixed P' the best P'' one of the columns. The
two are solved in turn, as in weight matching (Ainsworth et al., arXiv 2209.04836),
until neither changes, once from the rows and once from the columns. Each is solved
exactly, but together they may be a local optimum. The first layer has no P'', so its
optimum is global.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from optax.assignment import hungarian_algorithm

from rewire_jax.methods.wiring import Adapters, scores_of
from rewire_jax.nn.networks import Linear

MOST_TURNS = 20
"""Limit of the turns for one layer; in training, two or three are enough."""


def assign(gain: jax.Array) -> jax.Array:
    """Returns the order z `[n]` that maximises the sum of `gain[i, z[i]]`.

    Args:
      gain: `[n, n]`, the gain of putting the second index in place of the first.
    """
    # Values that are not finite belong to a diverged member; the solver needs numbers.
    finite = jnp.nan_to_num(gain, posinf=0.0, neginf=0.0)
    rows, columns = hungarian_algorithm(-finite)
    return jnp.zeros(len(gain), jnp.int32).at[rows].set(columns.astype(jnp.int32))


def match(
    hidden: Sequence[Linear], previous: Sequence[Linear], adapters: Adapters
) -> Adapters:
    """Returns adapters whose permutations minimise Eq. 11, as evenly spaced scores.

    Args:
      hidden: L current layers.
      previous: L layers at the end of the previous task.
      adapters: where to begin; the result is at least as close.
    """
    out, inp = (jnp.argsort(scores, axis=-1) for scores in adapters)
    outs, inps = [_match_rows(hidden[0], previous[0])], []
    for index, (now, then) in enumerate(zip(hidden[1:], previous[1:], strict=True)):
        row, column = _match_layer(now, then, out[index + 1], inp[index])
        outs.append(row)
        inps.append(column)
    shape = inp.shape  # One layer has no `inp`.
    return Adapters(
        scores_of(jnp.stack(outs)),
        scores_of(jnp.stack(inps)) if inps else jnp.zeros(shape),
    )


def _match_rows(now: Linear, then: Linear) -> jax.Array:
    """Returns the best order `[n]` of the previous rows, for columns as they are."""
    return assign(now.weight @ then.weight.T + jnp.outer(now.bias, then.bias))


def _match_layer(
    now: Linear, then: Linear, row: jax.Array, column: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the orders `[n]` of the previous rows and columns."""

    def turn(carry):
        count, _, row, column = carry
        new_row = _match_rows(now, Linear(then.weight[:, column], then.bias))
        new_column = assign(now.weight.T @ then.weight[new_row])
        changed = jnp.any(new_row != row) | jnp.any(new_column != column)
        return count + 1, changed, new_row, new_column

    def going(carry):
        count, changed, _, _ = carry
        return changed & (count < MOST_TURNS)

    def solve(column):
        start = 0, jnp.asarray(True), row, column
        _, _, rows, columns = jax.lax.while_loop(going, turn, start)
        met = then.weight[rows][:, columns]
        gain = jnp.sum(now.weight * met) + now.bias @ then.bias[rows]
        return gain, rows, columns

    row, column = row.astype(jnp.int32), column.astype(jnp.int32)
    # Once the rows come first, once the columns.
    first = assign(now.weight.T @ then.weight[row])
    gains, rows, columns = jax.vmap(solve)(jnp.stack([column, first]))
    best = jnp.argmax(gains)
    return rows[best], columns[best]
