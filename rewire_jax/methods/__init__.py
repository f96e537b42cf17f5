"""The methods, and what one of your own is made of."""

from rewire_jax.core.arguments import flag, require
from rewire_jax.core.pytrees import at, count, put, tile
from rewire_jax.core.settings import settings, static, traced
from rewire_jax.methods import cloning
from rewire_jax.methods.base import Candidates, Method, Selection, Tools
from rewire_jax.methods.finetune import FinetuneSettings, ft1, ft_n, sac_n
from rewire_jax.methods.registry import METHODS, Entry, find_method, register_method
from rewire_jax.methods.round import Round
from rewire_jax.methods.shared import Shared
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks

__all__ = [
    "METHODS",
    "Candidates",
    "Entry",
    "FinetuneSettings",
    "Method",
    "Round",
    "Selection",
    "Shared",
    "Spec",
    "Tools",
    "at",
    "cloning",
    "count",
    "find_method",
    "flag",
    "ft1",
    "ft_n",
    "networks",
    "put",
    "register_method",
    "require",
    "sac_n",
    "settings",
    "static",
    "tile",
    "traced",
]
