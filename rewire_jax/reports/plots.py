"""What all pictures share: colours, empty figures, titles, axes."""

import textwrap
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Okabe and Ito's palette, told apart with any colour vision; for its yellow, too pale
# for a line on white, come Tol's wine and grey. The line style changes too: methods can
# train alike, as FT-1 and FT-N do, and their curves lie on each other.
_COLOURS = (
    "#0072B2",
    "#009E73",
    "#CC79A7",
    "#000000",
    "#56B4E9",
    "#E69F00",
    "#882255",
    "#808080",
    "#D55E00",
)
_STYLES = ("-", "--", ":")
_ALIKE = 5  # lines of one style
_TOGETHER = 6  # methods that can be told apart in one panel
GREY = "; grey: the others"
"""How to read a figure that has a panel for each method."""


class Draw(Protocol):
    """Draws a method into a panel."""

    def __call__(
        self, axes: Axes, place: int, style: Mapping[str, Any], band: float
    ) -> None:
        """Draws.

        Args:
            axes: the panel.
            place: which method, from 0.
            style: of the line.
            band: opacity of the band around it; without one, 0.
        """


def mean(values: Array) -> Array:
    """Mean over the first axis without NaN; NaN, and no warning, where all are."""
    count = np.sum(~np.isnan(values), axis=0)
    total = np.nansum(values, axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def plain_text() -> AbstractContextManager[None]:
    """A context in which a name with dollars is no formula."""
    return rc_context({"text.parse_math": False})


def empty(
    size: tuple[float, float], rows: int, columns: int, *, shared: bool = False
) -> tuple[Figure, list[Axes]]:
    """A figure of its own: `pyplot` would keep state between calls.

    With `shared`, all panels have the same scales.
    """
    figure = Figure(figsize=size, dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    made = figure.subplots(rows, columns, squeeze=False, sharex=shared, sharey=shared)
    return figure, list(made.flat)


def grid(count: int) -> tuple[int, int]:
    """Rows and columns for this many panels."""
    columns = int(np.ceil(np.sqrt(count)))
    return -(-count // columns), columns


def methods_figure(
    labels: Sequence[str], size: tuple[float, float], draw: Draw
) -> tuple[Figure, list[Axes]]:
    """A figure of methods: a few in one panel, many in a panel each.

    A panel of one method shows the others in grey.

    Args:
        labels: of the methods.
        size: of the figure with one panel, in inches.
        draw: draws a method.

    Returns:
        The figure and its panels, without names, limits and formats of numbers.
    """
    if len(labels) <= _TOGETHER:
        figure, panels = empty(size, 1, 1)
        for place in range(len(labels)):
            draw(panels[0], place, look(place), max(0.09, 0.36 / max(2, len(labels))))
        key = [Line2D([], [], **look(i), label=label) for i, label in enumerate(labels)]
        figure.legend(handles=key, loc="outside right center", frameon=False)
        return figure, panels
    rows, columns = grid(len(labels))
    size = 2.9 * columns, 2.1 * rows + 0.6
    figure, panels = empty(size, rows, columns, shared=True)
    for place, (axes, label) in enumerate(zip(panels, labels, strict=False)):
        for other in range(len(labels)):
            if other != place:
                draw(axes, other, {"color": "0.85", "linewidth": 0.7}, 0)
        draw(axes, place, look(place) | {"linestyle": "-"}, 0.25)
        name = axes.text(
            0.03,
            0.96,
            wrapped(label),
            transform=axes.transAxes,
            verticalalignment="top",
            fontweight="bold",
            fontsize=9,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1},
        )
        # A long name must not make room for itself between the panels.
        name.set_in_layout(False)
        name.set_clip_on(True)
        below_is_free = place + columns >= len(labels)
        axes.tick_params(labelsize=8, labelbottom=below_is_free)
    for axes in panels[len(labels) :]:
        axes.set_axis_off()
    return figure, panels[: len(labels)]


def wrapped(label: str) -> str:
    """A label in lines that are short enough beside or in a panel."""
    return "\n".join(textwrap.wrap(label, 32))


def entitle(figure: Figure, title: str, reading: str) -> None:
    """Puts a title above a figure, and how to read it."""
    width = int(11 * figure.get_figwidth())
    lines = [*textwrap.wrap(title, width), *textwrap.wrap(reading, width)]
    figure.suptitle("\n".join(lines), fontsize=11)


def doubling(axes: Axes, values: Sequence[int]) -> None:
    """A horizontal axis of numbers that double, with a tick for each."""
    axes.set_xscale("log", base=2)
    axes.set_xticks(values, [str(value) for value in values])


def by_size(axes: Axes, sizes: Sequence[int], values: Sequence[float]) -> None:
    """A line of values above 0, by sizes that double."""
    axes.plot(sizes, values, marker="o", **look(0))
    doubling(axes, sizes)
    axes.set_ylim(0, None)


def look(i: int) -> dict[str, Any]:
    """The line of the method at a place: its colour and style, the same everywhere."""
    style = _STYLES[i // _ALIKE % len(_STYLES)]
    colour = _COLOURS[i % len(_COLOURS)]
    return {"color": colour, "linestyle": style, "linewidth": 1.6}
