"""Pictures of runs: learning curves over the sequence, and task × stage maps."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, StrMethodFormatter
from numpy.typing import NDArray

from rewire_jax.core.formatting import number
from rewire_jax.storage.scores import Score

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


class Line(NamedTuple):
    """One method's picture data; seeds without a valid result are left out before.

    Attributes:
        label: the method.
        curve: per stage, interactions within the task `[points]` and scores of
            training `[seeds, points]`, NaN where there is none.
        scores: evaluations `[seeds, 1 + stages, tasks]`, the first row before any
            training, NaN where there is none.
    """

    label: str
    curve: Sequence[tuple[Array, Array]]
    scores: Array


def mean(values: Array) -> Array:
    """Mean over the first axis without NaN; NaN, and no warning, where all are."""
    count = np.sum(~np.isnan(values), axis=0)
    total = np.nansum(values, axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def curves(
    lines: Sequence[Line],
    tasks: Sequence[str],
    budget: int,
    score: Score,
    title: str,
    path: Path,
) -> None:
    """Writes the scores of training over the whole sequence, tasks side by side.

    Args:
        lines: one for each method.
        tasks: names of the sequence.
        budget: interactions a task.
        score: what is shown.
        title: above the picture.
        path: the PNG file to write.
    """
    figure, (axes,) = empty((max(9.0, 1.6 * len(tasks)), 5.2), 1, 1)
    for i, line in enumerate(lines):
        _draw_curve(axes, i, line, budget, alpha=max(0.09, 0.36 / max(2, len(lines))))
    for k, name in enumerate(tasks):
        axes.axvline(k * budget, color="0.6", linewidth=0.8, zorder=0)
        # One word a line: eight long names fit side by side.
        label = name.replace("_", "\n").replace("-", "-\n")
        axes.annotate(
            label,
            xy=((k + 0.5) * budget, 1.0),
            xytext=(0, 5),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=9,
            linespacing=1.05,
        )
    axes.set_xlim(0, len(tasks) * budget)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    axes.set_xlabel("training interactions, each seed")
    axes.set_ylabel(score.noun)
    if score.limits:
        # Room for lines that run along an end.
        low, high = score.limits
        axes.set_ylim(low - 0.03 * (high - low), high + 0.03 * (high - low))
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    key = [Line2D([], [], **look(i), label=line.label) for i, line in enumerate(lines)]
    figure.legend(handles=key, loc="outside right center", frameon=False)
    entitle(
        figure,
        title,
        f"lines: {score.trained}, mean over seeds, band from lowest to highest",
    )
    figure.savefig(path)


def matrices(
    lines: Sequence[Line], tasks: Sequence[str], score: Score, title: str, path: Path
) -> None:
    """Writes a heat map of task × stage for each method, means in the cells.

    A frame marks where a task had just been trained. All maps share one colour scale.

    Args:
        lines: one for each method.
        tasks: names of the sequence.
        score: what is shown.
        title: above the picture.
        path: the PNG file to write.
    """
    maps = [mean(line.scores).T for line in lines]
    values = np.concatenate([m[~np.isnan(m)] for m in maps])
    low, high = (values.min(), values.max()) if values.size else (0.0, 1.0)
    low, high = score.limits or (low, high)
    # Equal ends would give a scale without extent.
    scale = Normalize(low, high if high > low else low + 1)
    columns = int(np.ceil(np.sqrt(len(lines))))
    rows = -(-len(lines) // columns)
    count = len(tasks)
    width = max(7.0, columns * (0.4 + 0.58 * (count + 1)) + 2.5)
    height = rows * (1.0 + 0.4 * count) + 1
    figure, panels = empty((width, height), rows, columns)
    # All cells of a picture have as many decimals as the largest needs.
    size = max(abs(low), abs(high))
    names = [f"{k + 1} {name}" for k, name in enumerate(tasks)]
    image = None
    for axes, line, cells in zip(panels, lines, maps, strict=False):
        image = axes.imshow(cells, cmap="cividis", norm=scale, aspect="auto")
        axes.set_title(line.label, fontsize=12)
        first = axes.get_subplotspec().is_first_col()  # type: ignore[union-attr]
        axes.set_yticks(range(count), names if first else [])
        axes.set_xticks(range(count + 1), ["before", *map(str, range(1, count + 1))])
        axes.set_ylabel("evaluated on" if first else "")
        axes.set_xlabel("after training on task")
        axes.tick_params(length=0, labelsize=9)
        for (task, stage), value in np.ndenumerate(cells):
            red, green, blue, _ = colormaps["cividis"](scale(value))
            dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
            colour = "white" if dark and not np.isnan(value) else "black"
            axes.text(
                stage,
                task,
                number(value, size),
                color=colour,
                ha="center",
                va="center",
                fontsize=8.5,
            )
        for task in range(count):
            if np.isnan(cells[task, task + 1]):
                continue
            axes.add_patch(
                Rectangle(
                    (task + 0.5, task - 0.5),
                    1,
                    1,
                    fill=False,
                    edgecolor="#D55E00",
                    linewidth=2,
                )
            )
    for axes in panels[len(lines) :]:
        axes.set_axis_off()
    if image is not None:
        figure.colorbar(
            image, ax=panels, label=f"{score.noun}, mean over seeds", aspect=20 * rows
        )
    entitle(figure, title, "framed: right after own training")
    figure.savefig(path)


def empty(
    size: tuple[float, float], rows: int, columns: int
) -> tuple[Figure, list[Axes]]:
    """A figure of its own: `pyplot` would keep state between calls."""
    figure = Figure(figsize=size, dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, columns, squeeze=False).flat)


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
    """Colour and line style of the method at a place, the same in all pictures."""
    style = _STYLES[i // _ALIKE % len(_STYLES)]
    return {"color": _COLOURS[i % len(_COLOURS)], "linestyle": style}


def _draw_curve(axes: Axes, i: int, line: Line, budget: int, alpha: float) -> None:
    """A method's curve, a piece for each task."""
    for stage, (x, scores) in enumerate(line.curve):
        middle = mean(scores)
        there = ~np.isnan(middle)
        x = x[there] + stage * budget
        if not x.size:
            continue
        low = np.nanmin(scores[:, there], axis=0)
        high = np.nanmax(scores[:, there], axis=0)
        colour = look(i)["color"]
        axes.fill_between(x, low, high, color=colour, alpha=alpha, linewidth=0)
        # A single point makes no line: its marker shows it.
        marker = "." if x.size == 1 else ""
        axes.plot(x, middle[there], **look(i), linewidth=1.6, marker=marker)
