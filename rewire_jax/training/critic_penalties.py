"""Penalties on the critics' weights, in their loss, so that they keep learning."""

from typing import Any

import jax
import jax.numpy as jnp

from rewire_jax.core.settings import SacSettings

_TUNED_WIDTH = 64
_SCALE = 2.0  # of W Wᵀ: the squared gain of an orthogonal layer before a ReLU


def add(loss: jax.Array, critic: Any, start: Any, sac: SacSettings) -> jax.Array:
    """The critics' loss with the penalties that are on; `start` is for `l2_init`."""
    if sac.l2_init:
        away = jax.tree.map(lambda w, first: w - first, critic, start)
        loss += sac.l2_init * sum(jnp.sum(w**2) for w in jax.tree.leaves(away))
    if sac.parseval:
        loss += sac.parseval * parseval(critic)
    return loss


def parseval(critic: Any) -> jax.Array:
    """How far both critics' hidden layers are from orthogonal ones, `[]`.

    The sum of (64 / n)² ||W Wᵀ - 2 I||² over the hidden layers, each with n neurons.
    The code of Chung et al., 2024, has this form; their coefficient is for n = 64.
    """
    total = jnp.zeros(())
    for layer in critic[:-1]:
        neurons = layer.weight.shape[-2]
        away = layer.weight @ layer.weight.mT - _SCALE * jnp.eye(neurons)
        total += (_TUNED_WIDTH / neurons) ** 2 * jnp.sum(away**2)
    return total
