"""Multi-layer perceptrons and the tanh-squashed Gaussian."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


class Linear(NamedTuple):
    """An affine layer.

    Attributes:
      weight: `[outputs, inputs]`, the W of W x + b: reordering a layer's output
        moves whole rows, and its gradient needs no transposition.
      bias: `[outputs]`.
    """

    weight: jax.Array
    bias: jax.Array


def init_linear(key: jax.Array, inputs: int, outputs: int) -> Linear:
    """A layer uniform in ±1/sqrt(inputs), weights and bias (PyTorch's default)."""
    bound = inputs**-0.5
    weight_key, bias_key = jax.random.split(key)
    return Linear(
        jax.random.uniform(weight_key, (outputs, inputs), minval=-bound, maxval=bound),
        jax.random.uniform(bias_key, (outputs,), minval=-bound, maxval=bound),
    )


def init_mlp(key: jax.Array, sizes: Sequence[int]) -> tuple[Linear, ...]:
    """Layers `sizes[0] -> sizes[1] -> ...`, one key each."""
    keys = jax.random.split(key, len(sizes) - 1)
    return tuple(map(init_linear, keys, sizes[:-1], sizes[1:]))


def activate(x: jax.Array) -> jax.Array:
    """LeakyReLU with slope 0.2, as in all networks of the paper's experiments."""
    return jax.nn.leaky_relu(x, 0.2)


def affine(layer: Linear, x: jax.Array) -> jax.Array:
    """`[..., inputs]` -> `[..., outputs]`."""
    return _product(x, layer.weight) + layer.bias


def _dot(x, y):
    """Products over the last axis of both, x yᵀ."""
    return jax.lax.dot_general(x, y, (((x.ndim - 1,), (1,)), ((), ())))


_product = jax.custom_jvp(_dot)


@_product.defjvp
def _product_jvp(primals, tangents):
    (x, weight), (by_x, by_weight) = primals, tangents
    # Its transpose, the weight's gradient, begins with that of the output transposed.
    turned = _dot(by_weight, x.reshape(-1, x.shape[-1]))
    if jax.default_backend() == "cpu":
        # Else XLA makes that a part of the product, and leaves such a one to a library
        # that takes a third longer.
        turned = jax.lax.optimization_barrier(turned)
    value = _dot(x, weight)
    return value, _dot(by_x, weight) + turned.T.reshape(value.shape)


def mlp(layers: Sequence[Linear], x: jax.Array) -> jax.Array:
    """Applies the layers with an activation between each two."""
    for layer in layers[:-1]:
        x = activate(affine(layer, x))
    return affine(layers[-1], x)


def gaussian(output: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Splits `[..., 2 * actions]` into mean and clipped log-std, `[..., actions]`."""
    mean, log_std = jnp.split(output, 2, axis=-1)
    return mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)


def mlp_policy(layers: Sequence[Linear], observation: jax.Array):
    """Mean and log-std, each `[..., actions]`, of a plain MLP policy."""
    return gaussian(mlp(layers, observation))


def sample_action(
    noise: jax.Array, mean: jax.Array, log_std: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """A reparameterised action tanh(mean + std noise) and its log-density.

    Args:
      noise: `[..., actions]`, from the standard normal distribution.
      mean: `[..., actions]`, before the squashing.
      log_std: `[..., actions]`.

    Returns:
      action `[..., actions]` in (-1, 1) and log-density `[...]` (arXiv 1812.05905,
      appendix C, with log(1 - tanh²u) written as 2(log 2 - |u| - log(1 + exp(-2|u|))).
    """
    raw = mean + jnp.exp(log_std) * noise
    log_density = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    # Among terms near 1, log1p adds no digit, and takes ten times as long on a CPU.
    size = jnp.abs(raw)
    squash = 2 * (jnp.log(2.0) - size - jnp.log(1 + jnp.exp(-2 * size)))
    return jnp.tanh(raw), jnp.sum(log_density - squash, axis=-1)
