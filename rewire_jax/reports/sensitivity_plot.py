"""Picture of performance along each axis of a sweep, the paper's Fig. 6."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator, StrMethodFormatter

from rewire_jax.core.formatting import short
from rewire_jax.reports.plots import empty, entitle, look

# Settings that the paper has a symbol for.
_SYMBOLS = {"modes": "K", "alpha": "α", "beta": "β", "tau": "τ"}
_DECADES = 2  # an axis that spans as many is logarithmic
_BEST = "#D55E00"


class Dot(NamedTuple):
    """A configuration's place in a panel.

    Attributes:
        value: on the axis.
        mean: performance over seeds; NaN leaves the dot out.
        std: its standard deviation, None with fewer than two seeds.
        whole: whether it came as far as any; otherwise it is drawn hollow.
        best: whether it is the one that was chosen.
    """

    value: float
    mean: float
    std: float | None
    whole: bool
    best: bool


def panels(
    axes: Sequence[tuple[str, Sequence[Dot]]],
    unit: str,
    title: str,
    reading: str,
    path: Path,
    *,
    joined: bool,
) -> None:
    """Writes a panel for each axis, all on one scale of performance.

    Args:
        axes: name and dots by value, one for each panel.
        unit: what performance is measured in.
        title: above the picture.
        reading: how to read it.
        path: the PNG file to write.
        joined: whether the dots of a panel make a line, and stand at the few values
            that the axis has.
    """
    columns = min(len(axes), 4)
    rows = -(-len(axes) // columns)
    size = max(7.0, 3.6 * columns + 0.6), 3.4 * rows + 1.0
    figure, places = empty(size, rows, columns)
    for place in places[1 : len(axes)]:
        place.sharey(places[0])
    for place, (name, dots) in zip(places, axes, strict=False):
        _draw(place, [dot for dot in dots if not np.isnan(dot.mean)], joined)
        values = np.array([dot.value for dot in dots])
        _scale(place, values, joined or bool(np.all(values % 1 == 0)))
        symbol = _SYMBOLS.get(name)
        place.set_xlabel(f"{symbol} ({name})" if symbol else name)
        place.grid(axis="y", color="0.9")
        place.set_axisbelow(True)
        place.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
        # On one scale, only the first of a row needs its numbers.
        first = place.get_subplotspec().is_first_col()  # type: ignore[union-attr]
        place.set_ylabel(f"performance ({unit})" if first else "")
        place.tick_params(labelleft=first)
    for place in places[len(axes) :]:
        place.set_axis_off()
    entitle(figure, title, reading)
    figure.savefig(path)


def logarithmic(values: np.ndarray) -> bool:
    """Whether an axis with these values, `[n]`, is logarithmic."""
    above = values[values > 0]
    wide = above.size > 0 and above.max() >= 10**_DECADES * above.min()
    return bool(wide and values.min() >= 0)


def _draw(place: Axes, dots: Sequence[Dot], joined: bool) -> None:
    line = [dot for dot in dots if dot.whole]
    if joined:
        where = [dot.value for dot in line]
        place.plot(where, [dot.mean for dot in line], **(look(0) | {"linewidth": 1.3}))
    for dot in dots:
        colour = _BEST if dot.best else look(0)["color"]
        place.errorbar(
            dot.value,
            dot.mean,
            yerr=dot.std,
            color=colour,
            marker="o",
            markersize=7 if joined else 5,
            markerfacecolor=colour if dot.whole else "white",
            capsize=3 if joined else 0,
            linewidth=1.3 if joined else 0.7,
            # The chosen one is drawn over the others.
            zorder=4 if dot.best else 3,
        )


def _scale(place: Axes, values: np.ndarray, chosen: bool) -> None:
    """Sets the scale across; a few chosen values are its ticks."""
    if logarithmic(values):
        least = values[values > 0].min()
        if values.min() > 0:
            place.set_xscale("log")
        else:
            # 0 stands a decade to the left of the smallest value above it.
            place.set_xscale("symlog", linthresh=least, linscale=0.9)
        place.xaxis.set_minor_locator(NullLocator())
    places = sorted(set(values.tolist()))
    if chosen and len(places) <= 8:
        place.set_xticks(places, [short(x) for x in places])
    place.margins(x=0.08)
