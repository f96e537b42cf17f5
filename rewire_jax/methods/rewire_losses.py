"""The losses of the rewiring method: L_KL (Eq. 6), L_reg (Eq. 7) and L_SP (Eq. 11).

`penalty` in `rewire.py` adds L_KL and L_SP, with their weights, to SAC's policy loss.
"""

from collections.abc import Iterable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from rewire_jax.methods.wiring import Adapters, adapt
from rewire_jax.nn.networks import Linear

Gaussian = tuple[jax.Array, jax.Array]
"""Mean and log-std, `[..., actions]` each."""


def distillation_loss(
    other: Gaussian, own: Gaussian, form: Literal["kl", "squares"]
) -> jax.Array:
    """L_KL, the divergence of the drawn mode from another mode (Eq. 6), or `squares`.

    Args:
      other: Gaussians of the other mode, without gradient.
      own: Gaussians of the drawn mode.
      form: see `RewireSettings.distillation`.

    Returns:
      `[]`, the mean over states.
    """
    divergence = gaussian_kl if form == "kl" else squared_differences
    return jnp.mean(divergence(jax.lax.stop_gradient(other), own))


def gaussian_kl(p: Gaussian, q: Gaussian) -> jax.Array:
    """KL(p || q) `[...]` of diagonal Gaussians (Eq. 6).

    Squashing both by the same tanh does not change it.
    """
    (p_mean, p_log_std), (q_mean, q_log_std) = p, q
    ratio = jnp.exp(2 * (p_log_std - q_log_std))
    distance = ((p_mean - q_mean) * jnp.exp(-q_log_std)) ** 2
    return jnp.sum(0.5 * (ratio + distance - 1) + q_log_std - p_log_std, axis=-1)


def squared_differences(p: Gaussian, q: Gaussian) -> jax.Array:
    """Summed squares of the differences of mean (p's within ±20) and log-std, `[...]`.

    The authors' code uses it in place of `gaussian_kl`.
    """
    (p_mean, p_log_std), (q_mean, q_log_std) = p, q
    mean = (jnp.clip(p_mean, -20, 20) - q_mean) ** 2
    return jnp.sum(mean + (p_log_std - q_log_std) ** 2, axis=-1)


def alignment_loss(
    hidden: Sequence[Linear],
    previous: Sequence[Linear],
    adapters: Adapters,
    tau: ArrayLike,
    *,
    expanded: bool = False,
) -> jax.Array:
    """L_SP, the squared distance to the adapted previous weights and biases (Eq. 11).

    It trains the weights and the adapters. The scores learn from SAC's loss and L_KL.

    Args:
      hidden: current layers.
      previous: layers at the end of the previous task.
      adapters: their permutation.
      tau: temperature of the adapters' relaxation.
      expanded: leave out the square of the adapted weights, as the authors' code does
        and all profiles do. It is constant under permutations, but not under their
        relaxation.

    Returns:
      `[]`.
    """
    adapted = adapt(previous, adapters, tau)
    if not expanded:
        return weight_loss(hidden, adapted)
    return sum(
        (jnp.sum(now**2 - 2 * now * then) for now, then in _pairs(hidden, adapted)),
        jnp.zeros(()),
    )


def weight_loss(hidden: Sequence[Linear], previous: Sequence[Linear]) -> jax.Array:
    """L_reg, the squared distance of weights and biases to other ones (Eq. 7), `[]`."""
    return sum(
        (jnp.sum((now - then) ** 2) for now, then in _pairs(hidden, previous)),
        jnp.zeros(()),
    )


def _pairs(hidden, others) -> Iterable[tuple[jax.Array, jax.Array]]:
    return zip(jax.tree.leaves(hidden), jax.tree.leaves(others), strict=True)
