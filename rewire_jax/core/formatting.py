"""Formats numbers for tables and pictures."""

import numpy as np


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
