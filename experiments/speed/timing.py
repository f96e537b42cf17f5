"""Loops that are timed in turn, round after round.

A busy machine then disturbs all alike. Rates are those of the best round and hold for
their machine only; ratios are medians of those within one round.
"""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import jax

Name = TypeVar("Name")
Loop = Callable[[int], Any]
"""Does something so many times, and returns what to wait for."""


class Timing(NamedTuple):
    """What a loop took.

    Attributes:
      repeats: repetitions in a round.
      seconds: of each round.
    """

    repeats: int
    seconds: list[float]

    @property
    def best(self) -> float:
        """Repetitions a second in the best round."""
        return self.repeats / min(self.seconds)

    @property
    def median(self) -> float:
        """Repetitions a second in the middle one."""
        return self.repeats / statistics.median(self.seconds)

    def over(self, other: "Timing") -> float:
        """How often this repeats while the other, timed in turn with it, does once."""
        pairs = zip(self.seconds, other.seconds, strict=True)
        ratio = statistics.median(theirs / ours for ours, theirs in pairs)
        return ratio * self.repeats / other.repeats

    def figures(self) -> dict[str, Any]:
        """A row's numbers."""
        return {
            "best": self.best,
            "median": self.median,
            "repeats": self.repeats,
            "seconds": self.seconds,
        }


def timed(function: Callable[..., Any], *arguments: Any) -> float:
    """Seconds until a function's result is ready."""
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


def repetitions(loop: Loop, seconds: float) -> int:
    """How often the loop repeats in about so long; even, for delayed updates."""
    timed(loop, 2)  # compiles
    count = 2
    while (taken := timed(loop, count)) < seconds / 4:
        count *= 4
    return 2 * max(1, round(count * seconds / taken / 2))


def in_turn(
    loops: Mapping[Name, Loop], rounds: int, seconds: float
) -> dict[Name, Timing]:
    """Times all loops, each for about so many seconds in every round."""
    counts = {name: repetitions(loop, seconds) for name, loop in loops.items()}
    rows = [{k: timed(f, counts[k]) for k, f in loops.items()} for _ in range(rounds)]
    return {k: Timing(count, [row[k] for row in rows]) for k, count in counts.items()}
