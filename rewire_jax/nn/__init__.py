"""The permutation and its gradient, and networks; as functions and Flax modules."""

from rewire_jax.nn.networks import MLP
from rewire_jax.nn.permutation import permute
from rewire_jax.nn.wired_layers import Permute, RewiredDense

__all__ = ["MLP", "Permute", "RewiredDense", "permute"]
