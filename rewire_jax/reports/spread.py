"""A value over seeds: mean with standard deviation, or with an interval."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.formatting import number


@dataclass(frozen=True)
class Spread:
    """A value over seeds, as text its mean ± standard deviation.

    Attributes:
        values: one a seed, NaN where missing.
        mean: None without values.
        std: the sample standard deviation, None with fewer than two seeds.
    """

    values: tuple[float, ...]
    mean: float | None
    std: float | None

    def __str__(self) -> str:
        """Mean ± standard deviation."""
        if self.mean is None or self.std is None:
            return number(self.mean)
        scale = max(abs(self.mean), self.std)
        return f"{number(self.mean, scale)} ± {number(self.std, scale)}"

    def columns(self, name: str) -> dict[str, Any]:
        """Mean and standard deviation as columns of a CSV."""
        return {f"{name}_mean": self.mean, f"{name}_std": self.std}


@dataclass(frozen=True)
class Interval:
    """A value with its 95% interval, None where there is none; as text both."""

    value: float | None
    low: float | None
    high: float | None

    def __str__(self) -> str:
        """The value and the ends of its interval."""
        if self.low is None or self.high is None:
            return number(self.value)
        scale = max(abs(self.low), abs(self.high))
        ends = f"[{number(self.low, scale)}, {number(self.high, scale)}]"
        return f"{number(self.value, scale)} {ends}"

    def differs_from(self, value: float) -> bool:
        """Whether the interval excludes a value."""
        if self.low is None or self.high is None:
            return False
        return not self.low <= value <= self.high

    def columns(self, name: str) -> dict[str, Any]:
        """The ends as columns of a CSV."""
        return {f"{name}_low": self.low, f"{name}_high": self.high}


def spread(values: NDArray[np.float64]) -> Spread:
    """Mean and sample standard deviation over seeds.

    Args:
        values: `[seeds]`; NaN is passed over.
    """
    there = values[~np.isnan(values)]
    return Spread(
        values=tuple(there.tolist()),
        mean=float(there.mean()) if there.size else None,
        std=float(there.std(ddof=1)) if there.size > 1 else None,
    )
