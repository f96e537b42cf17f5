"""The matrix products of an update: what it cannot do without."""

from itertools import pairwise

import jax

from experiments.speed.timing import Loop
from rewire_jax.methods.spec import Spec

SQUARE = [(256, 256, 256)]
Products = list[tuple[int, int, int]]
"""Matrix products: rows, inner size and columns of each."""


def products(spec: Spec, batch: int) -> tuple[Products, Products]:
    """The matrix products that a plain update needs, for critics and for policy.

    With P and C the sums of inputs × outputs over the layers of policy and critic,
    and o, a, n the sizes of observation, action and hidden layers, they take

      critics: batch × (P + 2 (C + 3 C − (o + a) n)) multiply-adds: the next action,
        the targets, and the critics forward, to their weights and to their layers;
      policy: batch × (3 P − o n + 2 (2 C − o n)): the policy in the same three
        ways, and the critics forward and back to the action.
    """
    o, a, n = spec.observations, spec.actions, spec.hidden
    policy = list(pairwise([o, *[n] * spec.depth, 2 * a]))
    critic = list(pairwise([o + a, *[n] * spec.depth, 1]))

    def forward(layers):
        return [(batch, inputs, outputs) for inputs, outputs in layers]

    def trained(layers):
        to_weights = [(inputs, batch, outputs) for inputs, outputs in layers]
        return forward(layers) + to_weights + backward(layers[1:])

    def backward(layers):
        return [(batch, outputs, inputs) for inputs, outputs in layers]

    judged = forward(critic) + backward([(a, n), *critic[1:]])
    return (
        forward(policy) + 2 * (forward(critic) + trained(critic)),
        trained(policy) + 2 * judged,
    )


def multiply_adds(some: Products) -> int:
    """Multiplications, each with an addition, in all the products together."""
    return sum(rows * inner * columns for rows, inner, columns in some)


def product_loop(some: Products) -> Loop:
    """Computes all the products, again and again."""

    def operand(number, rows, columns):
        bound = rows**-0.5
        key = jax.random.key(number)
        return jax.random.uniform(key, (rows, columns), minval=-bound, maxval=bound)

    left = [operand(2 * k, rows, inner) for k, (rows, inner, _) in enumerate(some)]
    right = [operand(2 * k + 1, *shape) for k, (_, *shape) in enumerate(some)]

    def once(_, carry):
        # Each product needs the one before, so that none can be moved or left out.
        left = [x.at[0, 0].set(y[0, 0]) for x, y in zip(*carry, strict=True)]
        return left, [x @ y for x, y in zip(left, right, strict=True)]

    start = (left, [x @ y for x, y in zip(left, right, strict=True)])
    return jax.jit(lambda count: jax.lax.fori_loop(0, count, once, start)[1])
