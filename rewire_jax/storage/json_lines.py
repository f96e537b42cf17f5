"""Reads JSON: documents, and tables of lines, the last of which may have been cut."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rewire_jax.core.errors import UserError, remedy

T = TypeVar("T")

# Raised on JSON that is not what was written here.
_DAMAGE = (
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    RecursionError,
)


def table(
    path: Path,
    parse: Callable[[dict[str, Any]], tuple[tuple[int, ...], T]],
    *,
    needed: bool = True,
) -> dict[tuple[int, ...], T]:
    """Rows of a file by key.

    Args:
        path: the file.
        parse: from a row to its key and value; it may fail as in `reading`.
        needed: otherwise a missing file is an empty table.

    Raises:
        UserError: the file is missing, or damaged elsewhere than in its last line, or
            has two rows of one key.
    """
    if not needed and not path.exists():
        return {}
    lines = text(path).split("\n")
    rows: dict[tuple[int, ...], T] = {}
    places: dict[tuple[int, ...], int] = {}
    # What follows the last line break is empty, or a line that was cut.
    for place, line in enumerate(lines[:-1], 1):
        with reading(f"{path}, line {place}"):
            key, value = parse(json.loads(line))
            if key in rows:
                raise ValueError(f"it repeats line {places[key]}")
            rows[key], places[key] = value, place
    return rows


def document(path: Path) -> Any:
    """What a JSON file holds; `UserError` if it cannot be read, or is damaged."""
    with reading(path):
        return json.loads(text(path))


@contextmanager
def reading(what: Path | str) -> Iterator[None]:
    """What fails inside because values are missing or odd is a `UserError`."""
    try:
        yield
    except _DAMAGE as error:
        why = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise UserError(f"{what} is damaged ({why[:200]})") from None


def text(path: Path) -> str:
    """What a file holds; `UserError` if it cannot be read."""
    # A crash may cut inside a character; JSON then refuses the line as it should.
    return raw(path).decode("utf-8", errors="replace")


def raw(path: Path) -> bytes:
    """The bytes of a file; `UserError` if it cannot be read."""
    try:
        # A device may have no end, and a pipe no beginning.
        if path.exists() and not path.is_file():
            raise UserError(f"cannot read {path}: not a file")
        return path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path} is missing: not the folder of a run") from None
    except OSError as error:
        told = f"cannot read {path}: {error.strerror}; {remedy(error.errno)}"
        raise UserError(told) from None


def number(value: float | None) -> float:
    """A number of JSON, where null means NaN."""
    return np.nan if value is None else float(value)
