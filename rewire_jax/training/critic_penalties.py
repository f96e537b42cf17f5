"""Penalties on the critics' weights, added to their loss, so that they keep learning."""

from typing import Any

import jax
import jax.numpy as jnp

_TUNED_WIDTH = 64
_SCALE = 2.0  # of W Wᵀ: the squared gain of an orthogonal layer before a ReLU


def l2_init(critic: Any, start: Any) -> jax.Array:
    """The squared distance `[]` of both critics to their first values.

    See Kumar et al., 2023.
    """
    away = jax.tree.map(lambda w, first: w - first, critic, start)
    return sum(jnp.sum(w**2) for w in jax.tree.leaves(away))  # type: ignore[return-value]


def parseval(critic: Any) -> jax.Array:
    """How far both critics' hidden layers are from orthogonal ones, `[]`.

    The sum of (64 / n)² ||W Wᵀ - 2 I||² over the hidden layers, each with n neurons: the
    form in the code of Chung et al., 2024, who chose their coefficient for n = 64.
    """
    total = jnp.zeros(())
    for layer in critic[:-1]:
        neurons = layer.weight.shape[-2]
        away = layer.weight @ layer.weight.mT - _SCALE * jnp.eye(neurons)
        total += (_TUNED_WIDTH / neurons) ** 2 * jnp.sum(away**2)
    return total
