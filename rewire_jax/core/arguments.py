"""Checks of arguments and of settings' values."""

import math
import numbers
from typing import Any

from rewire_jax.core.errors import UserError

MOST = 2**31 - 1  # Counters have 32 bits.


def require(condition: bool, message: str) -> None:
    """Raises `UserError(message)` unless the condition holds."""
    if not condition:
        raise UserError(message)


def flag(name: str) -> str:
    """The command-line flag of a setting."""
    return "--" + name.replace("_", "-")


def require_counts(group: Any, *names: str) -> None:
    """Raises `UserError` unless each of these values of a dataclass is at least 1."""
    for name in names:
        value = getattr(group, name)
        require(value >= 1, f"{flag(name)} must be at least 1, not {value}")


def require_weights(group: Any, *names: str) -> None:
    """Raises `UserError` unless each of these values is at least 0 and finite."""
    for name in names:
        value = getattr(group, name)
        fits = 0 <= value < math.inf
        require(fits, f"{flag(name)} must be at least 0 and finite, not {value}")


def is_real(value: Any) -> bool:
    """Whether a value is a single real number, of Python, NumPy or JAX."""
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        value = value.item()
    # In Python a bool is an int, too.
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def is_finite(value: Any) -> bool:
    """Whether a value is a single real number, neither NaN nor infinite."""
    return is_real(value) and bool(abs(value) < math.inf)


def check_whole(name: str, value: Any, least: int = 0, most: int = MOST) -> None:
    """Raises `UserError` unless a value is a whole number in a range.

    Args:
      name: name of the argument; with dashes if it is a flag, too.
      value: what was given.
      least: the smallest allowed number.
      most: the largest allowed number.
    """
    # In Python a bool is an int, too.
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not whole or not least <= value <= most:
        limits = f"at least {least}" if most == MOST else f"{least} to {most}"
        raise UserError(f"{name} must be a whole number, {limits}, not {value!r:.80}")


def check_optional(name: str, value: Any, least: int = 0, most: int = MOST) -> None:
    """The same as `check_whole`, but None is allowed."""
    if value is not None:
        check_whole(name, value, least, most)


def check_seconds(name: str, value: Any) -> None:
    """Raises `UserError` unless a value is a finite length of time, or 0."""
    if not is_finite(value) or value < 0:
        raise UserError(f"{name} must be a number of seconds, not {value!r:.80}")


def check_name(kind: str, value: Any) -> None:
    """Raises `UserError` unless a value can name something of this kind."""
    text = isinstance(value, str) and value.isprintable()
    if not text or not value or value != value.strip():
        raise UserError(f"a {kind}'s name must be printable text, not {value!r:.80}")
