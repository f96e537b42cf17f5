"""Imports `brax.v1`, the engine of the paper's runs, on a current JAX.

brax 0.12.3 is the last release that has it. Delete this file when `brax.v1` is no
longer used, or when a maintained copy of it runs on a current JAX.
"""

import contextlib
import importlib
import importlib.metadata
import io
import warnings
from types import ModuleType

import jax
import jax.numpy as jnp

from rewire_jax.core.errors import UserError

NEEDED = "0.12.3"


def module(name: str) -> ModuleType:
    """The module `brax.v1.<name>`.

    Raises:
      UserError: the installed brax has no `brax.v1`.
    """
    # brax.v1 warns that it is deprecated. It imports gym, which warns that it is
    # unmaintained.
    with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        _restore_names()
        try:
            return importlib.import_module(f"brax.v1.{name}")
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith(("brax.v1", "gym")):
                raise
            version = importlib.metadata.version("brax")
            raise UserError(
                f"--backend v1 needs brax {NEEDED}, but {version} is installed: "
                f"pip install 'brax=={NEEDED}', or use --backend positional"
            ) from error


def _restore_names() -> None:
    """Restores two names of JAX. `brax.v1.jumpy` needs them to tell NumPy from JAX."""
    if not hasattr(jax.interpreters.batching, "BatchTracer"):  # gone since jax 0.10
        setattr(jax.interpreters.batching, "BatchTracer", jax.core.Tracer)  # noqa: B010
    asked = "unsafe_am_i_under_a_jit_DO_NOT_USE"
    if not hasattr(jax.core, asked):  # gone since jax 0.12
        setattr(jax.core, asked, lambda: isinstance(jnp.zeros(()), jax.core.Tracer))
