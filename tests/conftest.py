"""Compiled programs are kept between test runs, in `.jax_cache`."""

import gc
import os
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest

# Set through the environment, before jax is imported, so that the processes a
# test starts share the cache. A value the caller has set is left alone.
_CACHE = Path(__file__).resolve().parent.parent / ".jax_cache"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")
# Tests compile much and compute little. Without fusion emitters, compiling takes two
# thirds of the time; newer XLA aborts on this flag.
_FLAGS = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
if version("jaxlib").startswith("0.10."):
    _FLAGS += " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", _FLAGS)


# Tracing makes many objects and few cycles; looking for them takes a tenth of the time.
gc.set_threshold(100_000, 50, 50)


# Long files first, so that no process waits long for another one at the end.
_ORDER = "docs", "training", "run", "envs", "methods", "cli", "experiments", "rendering"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def place(item: pytest.Item) -> int:
        folder = item.path.parent.name
        return _ORDER.index(folder) if folder in _ORDER else len(_ORDER)

    items.sort(key=place)


@pytest.fixture(autouse=True, scope="module")
def forget_programs() -> Iterator[None]:
    """Frees a file's compiled programs after it.

    Each takes memory maps, of which Linux grants a process 65,530 by default; XLA
    crashes where they run out.
    """
    yield
    import jax  # not before the settings above

    jax.clear_caches()
    gc.collect()
