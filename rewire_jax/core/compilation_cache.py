"""Compiled functions, kept on disk for later processes: JAX's persistent cache."""

import os
import sys
import tempfile
import warnings
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

from rewire_jax.core import kept_programs

OFF = "off"
VARIABLE = "REWIRE_JAX_CACHE"  # in the environment, the default of `folder`
_JAX_VARIABLE = "JAX_COMPILATION_CACHE_DIR"
# A cache that fails must not stop the program.
_FAILURES = "Error (reading|writing) persistent compilation cache entry"


def keep_compiled(folder: str | Path | None = None) -> Path | None:
    """Keeps compiled programs on disk, so that later processes can load them.

    Processes may share the folder. You can delete it at any time. JAX executes what is
    in it, so nobody else should be able to write to it. Traced programs are kept, too,
    see `kept_programs`, but not in a folder of JAX's own setting.

    Args:
      folder: where to keep them; "off" keeps nothing. If None, REWIRE_JAX_CACHE in the
        environment says it; if this is not set, JAX's own setting (such as
        JAX_COMPILATION_CACHE_DIR). If JAX has none, the folder is `rewire_jax` under
        XDG_CACHE_HOME or ~/.cache.

    Returns:
      The folder; None if nothing is kept. If this is not what you asked for, a line on
      standard error says why.
    """
    told = jax.config.values
    if not folder and kept_programs.programs_kept():
        return Path(told["jax_compilation_cache_dir"])  # of an earlier call
    kept_programs.keep_in(None)
    folder = folder or os.environ.get(VARIABLE)
    if folder:
        jax.config.update("jax_enable_compilation_cache", folder != OFF)
        told = jax.config.values
    if not told["jax_enable_compilation_cache"]:
        return None
    theirs = None if folder else told["jax_compilation_cache_dir"]
    try:
        folder = Path(folder or theirs or _default()).expanduser().absolute()
        if theirs and "://" in theirs:  # in a cloud
            return Path(theirs)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError) as error:  # the latter: no home
        why = f"cannot keep compiled programs for later: {error}"
        print(f"{why}; name another folder with --cache", file=sys.stderr)
        jax.config.update("jax_compilation_cache_dir", None)
        return None
    if theirs:
        return folder
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # To load even the smallest function is faster than to compile it.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    warnings.filterwarnings("ignore", _FAILURES)
    # Otherwise JAX would continue to use the folder from before.
    compilation_cache.reset_cache()
    kept_programs.keep_in(folder / "programs")
    return folder


def _default() -> Path:
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(caches) / "rewire_jax"


def environment() -> dict[str, str]:
    """Environment variables that give another process this one's folder."""
    told = jax.config.values
    if not told["jax_enable_compilation_cache"]:
        return {VARIABLE: OFF}
    variable = VARIABLE if kept_programs.programs_kept() else _JAX_VARIABLE
    folder = told["jax_compilation_cache_dir"]
    return {variable: folder} if folder else {}
