"""Counts what JAX compiles."""

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import jax

_EVENT = "/jax/core/compile/backend_compile_duration"
_EVERY_RUN = ("init", "begin", "chunk", "finish", "policies", "size")


@contextmanager
def compiles() -> Iterator[Counter[str]]:
    """Counts how often each function is compiled meanwhile, by name.

    What is found in the compilation cache counts, too: it was traced.
    """
    counts: Counter[str] = Counter()

    def listen(event: str, _: float, fun_name: str = "", **__: str | int) -> None:
        if event == _EVENT:
            counts[fun_name.removeprefix("jit(").removesuffix(")")] += 1

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield counts
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def assert_once(counts: Mapping[str, int], *more: str) -> None:
    """Each function of every run was compiled once, and so were these."""
    names = (*_EVERY_RUN, *more)
    assert {name: counts[name] for name in names} == dict.fromkeys(names, 1)
