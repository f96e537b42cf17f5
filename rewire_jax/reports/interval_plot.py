"""Picture of interquartile means with their intervals, best first."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.ticker import StrMethodFormatter

from rewire_jax.reports.plots import empty, entitle, look, wrapped
from rewire_jax.reports.spread import Interval

# Without a cap, so that a bar is as long as its interval.
_BAR: Any = {"linewidth": 5, "solid_capstyle": "butt"}


def intervals(
    values: Sequence[tuple[str, Interval]], quantity: str, title: str, path: Path
) -> None:
    """Writes a point and its interval for each method, the highest at the top.

    Args:
        values: label and value of each method, in the order of the other pictures; a
            method without a value is left out.
        quantity: what is shown.
        title: above the picture.
        path: the PNG file to write.
    """
    shown = [
        (each.value, i, label, each)
        for i, (label, each) in enumerate(values)
        if each.value is not None
    ]
    shown.sort(key=lambda entry: entry[0])
    labels = [wrapped(label) for _, _, label, _ in shown]
    lines = sum(1 + label.count("\n") for label in labels)
    figure, (axes,) = empty((8.0, max(3.2, 2.0 + 0.25 * lines)), 1, 1)
    for row, (value, i, _, each) in enumerate(shown):
        colour = look(i)["color"]
        if each.low is not None and each.high is not None:
            axes.plot([each.low, each.high], [row, row], color=colour, **_BAR)
        axes.plot(value, row, "o", color=colour, markersize=9, markeredgecolor="white")
    axes.set_yticks(range(len(shown)), labels)
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_xlabel(quantity)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    axes.grid(axis="x", color="0.9")
    axes.set_axisbelow(True)
    spread = any(each.low is not None for *_, each in shown)
    entitle(figure, title, "bars: 95% bootstrap intervals" if spread else "")
    figure.savefig(path)
