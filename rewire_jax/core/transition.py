"""The transitions that an update learns from."""

from typing import Any, NamedTuple

import jax


class Batch(NamedTuple):
    """Sampled transitions, all `[batch, ...]`; `action` in [-1, 1]."""

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    terminal: jax.Array
    truncated: jax.Array
    next_observation: jax.Array
    extras: Any = ()
