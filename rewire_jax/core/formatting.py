"""Formats numbers for tables and pictures, and reads times."""

import re

import numpy as np

from rewire_jax.core.errors import UserError


def number(value: float | None, scale: float | None = None) -> str:
    """A value as text; the smaller `scale`, the more decimals.

    Args:
        value: None and NaN are shown as a dash.
        scale: the magnitude that decides the number of decimals; the value's own if
            None.
    """
    if value is None or np.isnan(value):
        return "–"
    size = abs(value) if scale is None else scale
    text = f"{value:,.{0 if size >= 100 else 1 if size >= 10 else 2}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def short(value: float) -> str:
    """A setting's value in few characters: 1e-6, not 1e-06."""
    return f"{value:g}".replace("e-0", "e-").replace("e+0", "e+")


def seconds(text: str) -> float:
    """Seconds of a time such as 150m, 2h30m or 90s.

    Raises:
        UserError: it is not such a time, or it is 0.
    """
    found = re.fullmatch(r"(?:(\d+)h)?(?:(\d+)m)?(?:(\d+)s)?", text.strip())
    hours, minutes, rest = (
        (int(part or 0) for part in found.groups()) if found else [0] * 3
    )
    total = 3600 * hours + 60 * minutes + rest
    if not total:
        raise UserError(f"{text!r} is not a time: write it like 150m, 2h30m or 90s")
    return float(total)
