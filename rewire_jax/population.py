"""Members of a population: configurations times seeds, as stacked pytrees."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.config import SacSettings


class Members(NamedTuple):
    """What tells the members of a population apart, `[members]` on every leaf.

    Attributes:
      keys: random keys, made from the seed alone.
      sac: SAC's settings.
      options: the method's settings.
    """

    keys: jax.Array
    sac: SacSettings
    options: Any


def members(
    configurations: Sequence[tuple[SacSettings, Any]], seeds: Sequence[int]
) -> Members:
    """Every configuration with every seed, the seeds of one side by side.

    The configurations may differ only in their traced numbers.
    """

    def stack(*leaves):
        return jnp.repeat(jnp.asarray(leaves, jnp.result_type(*leaves)), len(seeds))

    def stacked(settings):
        return jax.tree.map(stack, *settings)

    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
    return Members(
        keys=jnp.tile(keys, len(configurations)),
        sac=stacked([sac for sac, _ in configurations]),
        options=stacked([options for _, options in configurations]),
    )
