"""Multi-layer perceptrons and the tanh-squashed Gaussian.

Parameters are stored as a tuple of `Linear`, a layer each: methods reorder, mix and
prune them layer by layer. `MLP` is the Flax module of the same network;
`as_variables` and `as_layers` rename one form into the other without a copy.

The networks of `ACTIVATIONS` differ only in what is between two layers. It has no
parameters, so the stored form is the same. A rewired network is an ordinary one with
each of them: reordering a layer's output is reordering its rows.

"mlp" and "layer_norm" treat all neurons alike, so the order of a hidden layer's neurons
does not matter: permuting the rows of its weight and bias, and the columns of the next
layer's weight, leaves the output as it is. With "residual" it matters, because a neuron
is added to the one in its place in the layer before.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import chex
import flax.linen as nn
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


Activation = Callable[[jax.Array], jax.Array]
"""What is between two layers, `[..., neurons]` -> `[..., neurons]`."""


@dataclasses.dataclass(frozen=True)
class Residual:
    """An activation that is added to the hidden layer before.

    Attributes:
      activation: of x, without what it is added to.
    """

    activation: Activation


AnyActivation = Activation | Residual


def between(
    activation: AnyActivation, x: jax.Array, below: jax.Array | None
) -> jax.Array:
    """A hidden layer's activations `[..., neurons]`.

    Args:
      activation: what is between two layers.
      x: `[..., neurons]`, output of the layer.
      below: activations of the hidden layer before, None for the first one.
    """
    if not isinstance(activation, Residual):
        return activation(x)
    x = activation.activation(x)
    return x if below is None else below + x


def activate(x: jax.Array) -> jax.Array:
    """LeakyReLU with slope 0.2, as in all networks of the paper's experiments."""
    return jax.nn.leaky_relu(x, 0.2)


def normalize_and_activate(x: jax.Array) -> jax.Array:
    """LeakyReLU of x with mean 0 and variance 1 over its last axis.

    The first part is Flax's `LayerNorm(use_scale=False, use_bias=False)`.
    """
    # The variance from squares alone, the default, may come out negative.
    variance = jnp.var(x, axis=-1, keepdims=True)
    return activate(jax.nn.standardize(x, variance=variance, epsilon=1e-6))


ACTIVATIONS: Mapping[str, AnyActivation] = {
    "mlp": activate,
    "layer_norm": normalize_and_activate,
    "residual": Residual(normalize_and_activate),
}
"""By the names of `SacSettings.network`."""


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


class Dense(nn.Module):
    """The affine layer W x + b as a module, uniform in ±1/sqrt(inputs) at first.

    Its parameters are those of `Linear`.

    Attributes:
      features: length of the output.
      key: what the first parameters are drawn with; Flax's own key if None.
    """

    features: int
    key: jax.Array | None = None

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[..., inputs]` -> `[..., features]`.

        Raises:
          AssertionError: x is not of floats.
          flax.errors.ScopeParamShapeError: the parameters are for other sizes.
        """
        chex.assert_type(x, float)
        return affine(linear_params(self, x.shape[-1], self.features, self.key), x)


def linear_params(
    module: nn.Module, inputs: int, outputs: int, key: jax.Array | None = None
) -> Linear:
    """A module's parameters `weight` and `bias`, see `Dense`."""

    def initial(own, name):
        layer = init_linear(own if key is None else key, inputs, outputs)
        return getattr(layer, name)

    return Linear(*(module.param(name, initial, name) for name in Linear._fields))


class MLP(nn.Module):
    """Dense layers with an activation between each two: every policy and critic.

    The same key gives the same first parameters as `init_mlp`.

    Attributes:
      features: length of each layer's output: `[hidden] * depth + [outputs]`.
      activation: between the layers.
    """

    features: Sequence[int]
    activation: AnyActivation = activate

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[..., inputs]` -> `[..., features[-1]]`; errors as of `Dense`."""
        below = None
        for index, (size, key) in enumerate(
            zip(self.features, self._keys(), strict=True)
        ):
            if index:
                x = below = between(self.activation, x, below)
            x = Dense(size, key, name=_name(index))(x)
        return x

    def _keys(self) -> Sequence[jax.Array | None]:
        """Of the layers' first parameters; None where parameters are given."""
        if self.scope is None or not self.is_initializing():
            return [None] * len(self.features)
        # `make_rng` would fold a count into it: other numbers than those of all runs.
        key = self.scope.rngs["params"].as_jax_rng()
        return list(jax.random.split(key, len(self.features)))


def _name(index: int) -> str:
    return f"layers_{index}"


def as_variables(layers: Sequence[Linear]) -> dict[str, Any]:
    """What `MLP.apply` takes, from the stored form."""
    return {
        "params": {_name(i): layer._asdict() for i, layer in enumerate(layers)},
    }


def as_layers(variables: Mapping[str, Any]) -> tuple[Linear, ...]:
    """The stored form of what `MLP.init` gives."""
    params = variables["params"]
    return tuple(Linear(**params[_name(i)]) for i in range(len(params)))


def init_mlp(key: jax.Array, sizes: Sequence[int]) -> tuple[Linear, ...]:
    """Layers `sizes[0] -> sizes[1] -> ...` of an `MLP`, one key each."""
    return as_layers(MLP(sizes[1:]).init(key, jnp.zeros(sizes[0])))


def mlp(
    layers: Sequence[Linear], x: jax.Array, activation: AnyActivation = activate
) -> jax.Array:
    """Applies the `MLP` with these layers, `[..., inputs]` -> `[..., outputs]`."""
    network = MLP([layer.bias.shape[-1] for layer in layers], activation)
    output: jax.Array = network.apply(as_variables(layers), x)  # type: ignore[assignment]
    return output


def hidden_activations(
    layers: Sequence[Linear], x: jax.Array, activation: AnyActivation = activate
) -> list[jax.Array]:
    """Activations `[..., neurons]` of each hidden layer of the `MLP`."""
    activations: list[jax.Array] = []
    for layer in layers[:-1]:
        below = activations[-1] if activations else None
        x = between(activation, affine(layer, x), below)
        activations.append(x)
    return activations


@functools.cache
def hidden_of(network: str) -> Callable[..., list[jax.Array]]:
    """`hidden_activations` with a network's activation."""
    return functools.partial(hidden_activations, activation=ACTIVATIONS[network])


def sizes(layers: Sequence[Linear]) -> list[int]:
    """The sizes from which `init_mlp` makes layers of the same shapes."""
    return [layers[0].weight.shape[-1], *(layer.bias.shape[-1] for layer in layers)]


def gaussian(output: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Splits `[..., 2 * actions]` into mean and clipped log-std, `[..., actions]`."""
    mean, log_std = jnp.split(output, 2, axis=-1)
    return mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)


def mlp_policy(
    layers: Sequence[Linear],
    observation: jax.Array,
    activation: AnyActivation = activate,
) -> tuple[jax.Array, jax.Array]:
    """Mean and log-std, each `[..., actions]`, of a plain MLP policy."""
    return gaussian(mlp(layers, observation, activation))


@functools.cache
def policy_of(network: str) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """`mlp_policy` with a network's activation; always the same object for a name."""
    return functools.partial(mlp_policy, activation=ACTIVATIONS[network])


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
      appendix C). We write log(1 - tanh(u)²) as
      `2 * (log(2) - abs(u) - log(1 + exp(-2 * abs(u))))`.
    """
    raw = mean + jnp.exp(log_std) * noise
    log_density = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    # Among terms near 1, log1p adds no digit, and takes ten times as long on a CPU.
    size = jnp.abs(raw)
    squash = 2 * (jnp.log(2.0) - size - jnp.log(1 + jnp.exp(-2 * size)))
    return jnp.tanh(raw), jnp.sum(log_density - squash, axis=-1)
