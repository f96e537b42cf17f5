"""Numbers as tables and pictures show them."""

import numpy as np


def number(value: float | None, scale: float | None = None) -> str:
    """A value as tables and cells show it; more decimals where `scale` is small.

    Args:
        value: None and NaN are shown as a dash.
        scale: the magnitude that decides the decimals, by default the value's own.
    """
    if value is None or np.isnan(value):
        return "–"
    size = abs(value) if scale is None else scale
    text = f"{value:,.{0 if size >= 100 else 1 if size >= 10 else 2}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def short(value: float) -> str:
    """A setting's value in few characters: 1e-6, not 1e-06."""
    return f"{value:g}".replace("e-0", "e-").replace("e+0", "e+")
