"""What a device is told to do, and how long it has nothing to do.

Kernels, loops and branches are counted in the text of a compiled program. A loop whose
length the compiler knows can be launched as a whole. One of unknown length, and each
branch, may make the device wait for the host.
"""

import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax

from experiments.suite import Row

# Instructions without a kernel of their own; the end of an asynchronous one is none.
_FREE = re.compile(
    r"parameter|constant|tuple|get-tuple-element|bitcast|after-all|opt-barrier"
    r"|partition-id|replica-id|while|conditional|call|.*-(done|update)"
)
_COMPUTATION = re.compile(r"(ENTRY )?%?([\w.-]+) .*\{$")
# A name, a type that ends with a bracket, an operation and what follows it.
_INSTRUCTION = re.compile(r"\s+(?:ROOT )?%?[\w.-]+ = .*?[\])}] ([a-z][\w-]*)\((.*)")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"')


class _Instruction(NamedTuple):
    operation: str
    rest: str

    def named(self, *attributes: str) -> list[str]:
        """The computations in these attributes."""
        found = re.findall(
            rf"\b(?:{'|'.join(attributes)})=(\{{[^}}]*\}}|%?[\w.-]+)", self.rest
        )
        return [name for each in found for name in re.findall(r"[\w.-]+", each)]


def kernels(compiled: jax.stages.Compiled) -> list[Row]:
    """Counts in a compiled program, see `loops`.

    Raises:
      ValueError: the program has no text.
    """
    text = compiled.as_text()
    if text is None:
        raise ValueError("the compiled program has no text")
    return loops(text)


def loops(text: str) -> list[Row]:
    """Counts what is launched, from the text of an optimised program.

    Args:
      text: the program in XLA's HLO.

    Returns:
      A row for the program and for each loop in it, in their order: its `depth`, its
      `trips` (None if not known), and the `kernels`, `while` and `conditional`
      instructions in it, all branches included, those of inner loops not.
    """
    bodies, entry = _computations(text)
    return list(_walk(bodies, entry, 0, 1))


def _computations(text: str) -> tuple[dict[str, list[_Instruction]], str]:
    bodies: dict[str, list[_Instruction]] = {}
    entry, body = "", []
    for line in text.splitlines():
        if found := _INSTRUCTION.match(line):
            body.append(_Instruction(found[1], found[2]))
        elif found := _COMPUTATION.match(line):
            body = bodies[found[2]] = []
            entry = found[2] if found[1] else entry
    return bodies, entry


def _walk(
    bodies: dict[str, list[_Instruction]], name: str, depth: int, trips: int | None
) -> Iterator[Row]:
    row: Row = {"loop": name, "depth": depth, "trips": trips}
    row |= {"kernels": 0, "while": 0, "conditional": 0}
    inner: list[Any] = []

    def count(name):
        for one in bodies[name]:
            row["kernels"] += not _FREE.fullmatch(one.operation)
            if one.operation == "while":
                known = _TRIPS.search(one.rest)
                (body,) = one.named("body")
                inner.append((body, int(known[1]) if known else None))
                row["while"] += 1
                for condition in one.named("condition") if not known else ():
                    count(condition)
            elif one.operation == "conditional":
                row["conditional"] += 1
                branches = ("branch_computations", "true_computation")
                for branch in one.named(*branches, "false_computation"):
                    count(branch)
            elif one.operation == "call":
                for called in one.named("to_apply"):
                    count(called)

    count(name)
    yield row
    for body, length in inner:
        yield from _walk(bodies, body, depth + 1, length)


def profile(function: Callable[[], Any]) -> Row:
    """Profiles a call of a function that was called before.

    Returns:
      `planes`, the names of what was traced; on a GPU also `kernels`, how many it ran,
      and `waits`, the share of the time in which all its streams were idle.
    """
    with tempfile.TemporaryDirectory() as name:
        with jax.profiler.trace(name):
            jax.block_until_ready(function())
        (path,) = Path(name).rglob("*.xplane.pb")
        planes = list(jax.profiler.ProfileData.from_file(str(path)).planes)
    spans = [
        (event.start_ns, event.start_ns + event.duration_ns)
        for plane in planes
        for line in plane.lines
        if line.name.startswith("Stream")
        for event in line.events
    ]
    row: Row = {"planes": [plane.name for plane in planes]}
    return row | {"kernels": len(spans), "waits": idle(spans)} if spans else row


def idle(spans: Iterable[tuple[float, float]]) -> float:
    """Share of the time from the first start to the last end that is in no span."""
    first, *others = sorted(spans)
    empty, end = 0.0, first[1]
    for start, stop in others:
        empty, end = empty + max(start - end, 0), max(end, stop)
    return empty / (end - first[0])
