"""Compiled functions, kept on disk for later processes: JAX's persistent cache."""

import os
import sys
import tempfile
import warnings
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

OFF = "off"
# A cache that fails is as good as none.
_FAILURES = "Error (reading|writing) persistent compilation cache entry"


def keep_compiled(folder: str | Path | None = None) -> Path | None:
    """Keeps what is compiled from now on, so that later processes need not.

    Processes may share the folder, and it can be deleted at any time. What lies in it
    is executed: it should be nobody else's to write to.

    Args:
      folder: where; "off" for nowhere. If None, what JAX was told (as by
        JAX_COMPILATION_CACHE_DIR) stays as it is; if that is nothing, `rewire_jax` in
        the user's folder for caches, XDG_CACHE_HOME or ~/.cache.

    Returns:
      The folder; None if nothing is kept, which a line on standard error explains
      where it was not asked for.
    """
    if folder == OFF:
        jax.config.update("jax_enable_compilation_cache", False)
    told = jax.config.values
    if not told["jax_enable_compilation_cache"]:
        return None
    if folder is None and told["jax_compilation_cache_dir"]:
        return Path(told["jax_compilation_cache_dir"])
    try:
        folder = Path(folder or _default()).expanduser().absolute()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError) as error:  # the latter: no home
        print(f"what is compiled is not kept for later: {error}", file=sys.stderr)
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # Even the smallest function is read faster than compiled.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    warnings.filterwarnings("ignore", _FAILURES)
    # A folder that was in use before would be still.
    compilation_cache.reset_cache()
    return folder


def _default() -> Path:
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(caches) / "rewire_jax"
