"""Dormant neurons and their reset; the effective rank of what neurons compute.

A network that has learned for long may learn ever more slowly: it loses plasticity. The
share of dormant neurons rises then (Sokar et al., arXiv 2302.12902), and the effective
rank of the last hidden layer falls (Kumar et al., arXiv 2010.14498).
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from rewire_jax.nn.networks import Linear


def dormant(activations: jax.Array, threshold: ArrayLike) -> jax.Array:
    """Which neurons of a layer hardly ever contribute, `[..., n]` bool.

    Those whose mean absolute activation is at most `threshold` times the layer's mean
    of it (arXiv 2302.12902, Eq. 1).

    Args:
      activations: `[..., batch, n]`.
      threshold: `[]`.
    """
    score = jnp.mean(jnp.abs(activations), axis=-2)
    return score <= threshold * jnp.mean(score, axis=-1, keepdims=True)


def effective_rank(features: jax.Array) -> jax.Array:
    """Exp of the entropy of the singular values, divided by their sum, `[...]`.

    Roy and Vetterli (2007). Of `[..., batch, n]` features it is between 1 and the rank
    of the matrix; 1 also if all are 0.
    """
    values = jnp.linalg.svd(features, compute_uv=False)
    total = jnp.sum(values, axis=-1, keepdims=True)
    shares = values / jnp.where(total > 0, total, 1.0)
    return jnp.exp(jnp.sum(jax.scipy.special.entr(shares), axis=-1))


def renew(
    layers: Sequence[Linear], neurons: Sequence[jax.Array], fresh: Sequence[Linear]
) -> tuple[Linear, ...]:
    """The layers of an MLP whose chosen neurons start anew (arXiv 2302.12902).

    Their incoming weights and biases become those of `fresh`. Their outgoing weights
    become 0, also those that lead to another chosen neuron.

    Args:
      layers: layers of an MLP; all arrays may have leading axes.
      neurons: for each hidden layer which neurons, `[..., n]` bool.
      fresh: layers of the same shapes.
    """
    renewed = []
    for index, (layer, new) in enumerate(zip(layers, fresh, strict=True)):
        weight, bias = layer
        if index < len(neurons):
            here = neurons[index]
            weight = jnp.where(here[..., None], new.weight, weight)
            bias = jnp.where(here, new.bias, bias)
        if index > 0:
            weight = jnp.where(neurons[index - 1][..., None, :], 0.0, weight)
        renewed.append(Linear(weight, bias))
    return tuple(renewed)
