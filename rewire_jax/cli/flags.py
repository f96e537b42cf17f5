"""Flags that every command of `rewire-jax` has."""

from dataclasses import dataclass

import tyro


@dataclass(frozen=True, kw_only=True)
class Flags:
    """Flags of every command.

    Attributes:
      cache: folder for compiled programs; "off" keeps none. By default the folder in
        JAX_COMPILATION_CACHE_DIR if it is set, else ~/.cache/rewire_jax.
      debug: print the traceback of an error.
      version: print the version and exit.
    """

    cache: str | None = None
    debug: tyro.conf.FlagCreatePairsOff[bool] = False
    version: tyro.conf.FlagCreatePairsOff[bool] = False
