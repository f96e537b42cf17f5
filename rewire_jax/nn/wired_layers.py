"""Layers with a learned permutation of their neurons, as functions and as modules."""

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from rewire_jax.nn.networks import Linear, affine, linear_params
from rewire_jax.nn.permutation import permute, permute_rows


def even_scores(n: int) -> jax.Array:
    """Scores `[n]` evenly spaced in [0, 1]: the permutation that moves nothing."""
    return jnp.arange(n) / max(n - 1, 1)


def permute_outputs(layer: Linear, scores: jax.Array, tau: ArrayLike) -> Linear:
    """The layer whose output is `permute(layer's output, scores, tau)`.

    Both gradients are those of permuting the output, summed over the batch, at
    the cost of a permutation of the weights.
    """
    return Linear(*permute_rows(list(layer), scores, tau))


def wired(layer: Linear, scores: jax.Array, tau: ArrayLike, x: jax.Array) -> jax.Array:
    """A layer's output `[..., n]` for x `[..., inputs]`, in the order of scores `[n]`.

    Eq. 2, before the activation. With a large batch it permutes the weights, with a
    small one the output: value and gradients are the same.
    """
    batch, inputs = x.size // x.shape[-1], x.shape[-1]
    if batch < inputs:
        return permute(affine(layer, x), scores, tau)
    return affine(permute_outputs(layer, scores, tau), x)


class Permute(nn.Module):
    """Reorders the last axis by ascending scores, which it learns (`permute`).

    Its parameter is `scores` `[n]`, from `even_scores`.

    Attributes:
      tau: temperature of the relaxation, positive (Eq. 4).
    """

    tau: ArrayLike = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[..., n]` -> `[..., n]`.

        Raises:
          AssertionError: x is not of floats.
          flax.errors.ScopeParamShapeError: there are not n scores.
        """
        return permute(x, _scores(self, x.shape[-1]), self.tau)


class RewiredDense(nn.Module):
    """A dense layer whose neurons come in a learned order (Eq. 2), see `wired`.

    Its parameters are `weight` `[features, inputs]`, `bias` `[features]` and `scores`
    `[features]`. It has no activation.

    Attributes:
      features: length of the output.
      tau: temperature of the relaxation, positive (Eq. 4).
    """

    features: int
    tau: ArrayLike = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[..., inputs]` -> `[..., features]`.

        Raises:
          AssertionError: x is not of floats.
          flax.errors.ScopeParamShapeError: the parameters are for other sizes.
        """
        chex.assert_type(x, float)
        layer = linear_params(self, x.shape[-1], self.features)
        return wired(layer, _scores(self, self.features), self.tau, x)


def _scores(module: nn.Module, n: int) -> jax.Array:
    """A module's parameter `scores` `[n]`."""
    return module.param("scores", lambda key: even_scores(n))
