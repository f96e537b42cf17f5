"""Parts that all policies of a member have in common."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax


class Shared(NamedTuple):
    """A part that all of a member's policies have in common; it is stored once."""

    value: Any


def map_own(function: Callable[[jax.Array], Any], policies: Any) -> Any:
    """Maps a function over the arrays of stacked policies, except `Shared` parts."""
    return jax.tree.map(
        lambda x: x if isinstance(x, Shared) else function(x), policies, is_leaf=_shared
    )


def axes(policies: Any) -> Any:
    """Returns the `vmap` axes of stacked policies: None for `Shared` parts, else 0."""
    return jax.tree.map(
        lambda x: None if isinstance(x, Shared) else 0, policies, is_leaf=_shared
    )


def _shared(part: Any) -> bool:
    return isinstance(part, Shared)
