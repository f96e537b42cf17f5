"""Reads tables of JSON lines, the last of which a crash may have cut."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rewire_jax.errors import UserError

T = TypeVar("T")


def table(
    path: Path,
    parse: Callable[[dict[str, Any]], tuple[tuple[int, ...], T]],
    *,
    needed: bool = True,
) -> dict[tuple[int, ...], T]:
    """Rows of a file by key; later rows replace earlier ones.

    Args:
        path: the file.
        parse: from a row to its key and value; `ValueError`, `TypeError` and
            `KeyError` say that the row is damaged.
        needed: otherwise a missing file is an empty table.

    Raises:
        UserError: the file is missing, or damaged elsewhere than in its last line.
    """
    if not needed and not path.exists():
        return {}
    lines = text(path).split("\n")
    rows = {}
    # What follows the last line break is empty, or a line that was cut.
    for place, line in enumerate(lines[:-1], 1):
        try:
            key, value = parse(json.loads(line))
        except (ValueError, TypeError, KeyError) as error:
            why = reason(error)
            raise UserError(f"{path}, line {place} is damaged ({why})") from None
        rows[key] = value
    return rows


def text(path: Path) -> str:
    """What a file holds; `UserError` if it cannot be read."""
    try:
        # A crash may cut inside a character; JSON then refuses the line as it should.
        return path.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        raise UserError(f"{path} is missing: not the folder of a run") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None


def index(row: dict[str, Any], name: str, low: int, high: int) -> int:
    """A row's place on an axis, from `low` to below `high`, else `ValueError`."""
    value = int(row[name])
    if not low <= value < high:
        raise ValueError(f"{name} {value} is not in {low} to {high - 1}")
    return value


def number(value: float | None) -> float:
    """A number of JSON, whose null stands for NaN."""
    return np.nan if value is None else float(value)


def reason(error: Exception) -> str:
    """Why a row is damaged, in a few words."""
    return f"no {error}" if isinstance(error, KeyError) else str(error)
