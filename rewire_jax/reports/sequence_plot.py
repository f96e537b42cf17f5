"""Picture of learning curves over the sequence of tasks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, StrMethodFormatter

from rewire_jax.reports.plots import GREY, Array, entitle, mean, methods_figure
from rewire_jax.storage.scores import Score

_NAMED = 5  # tasks whose names have room above a small panel


class Training(NamedTuple):
    """A method's training; seeds without a valid result are left out before.

    Attributes:
        label: the method.
        stages: interactions within the task `[points]` and scores of training
            `[seeds, points]`, NaN where there is none, for each task.
    """

    label: str
    stages: Sequence[tuple[Array, Array]]


def curves(
    trained: Sequence[Training],
    tasks: Sequence[str],
    budget: int,
    score: Score,
    title: str,
    path: Path,
) -> None:
    """Writes the scores of training over the whole sequence, tasks side by side.

    Args:
        trained: one for each method.
        tasks: names of the sequence.
        budget: interactions a task.
        score: what is shown.
        title: above the picture.
        path: the PNG file to write.
    """

    def draw(axes: Axes, place: int, style: Mapping[str, Any], band: float) -> None:
        for stage, (x, scores) in enumerate(trained[place].stages):
            _draw_stage(axes, x + stage * budget, scores, style, band)

    labels = [each.label for each in trained]
    size = max(9.0, 1.6 * len(tasks)), 5.2
    figure, panels = methods_figure(labels, size, draw)
    together = len(panels) == 1
    named = together or len(tasks) <= _NAMED
    names = tasks if named else [str(k + 1) for k in range(len(tasks))]
    for axes in panels:
        for k in range(len(tasks)):
            axes.axvline(k * budget, color="0.6", linewidth=0.8, zorder=0)
        axes.grid(axis="y", color="0.9")
        axes.set_axisbelow(True)
        if axes.get_subplotspec().is_first_row():  # type: ignore[union-attr]
            _name_tasks(axes, names, budget, 9 if together else 6)
    first = panels[0]
    first.set_xlim(0, len(tasks) * budget)
    first.xaxis.set_major_formatter(EngFormatter(sep=""))
    first.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    figure.supxlabel("training interactions, each seed", fontsize=10)
    figure.supylabel(score.noun, fontsize=10)
    if score.limits:
        # Room for lines that run along an end.
        low, high = score.limits
        first.set_ylim(low - 0.03 * (high - low), high + 0.03 * (high - low))
    reading = f"lines: {score.trained}, mean over seeds, band from lowest to highest"
    entitle(figure, title, reading + ("" if together else GREY))
    figure.savefig(path)


def _draw_stage(
    axes: Axes, x: Array, scores: Array, style: Mapping[str, Any], band: float
) -> None:
    """A method's curve in a task."""
    middle = mean(scores)
    there = ~np.isnan(middle)
    x = x[there]
    if not x.size:
        return
    if band:
        low = np.nanmin(scores[:, there], axis=0)
        high = np.nanmax(scores[:, there], axis=0)
        axes.fill_between(x, low, high, color=style["color"], alpha=band, linewidth=0)
    # A single point makes no line: its marker shows it.
    axes.plot(x, middle[there], **style, marker="." if x.size == 1 else "")


def _name_tasks(axes: Axes, tasks: Sequence[str], budget: int, size: float) -> None:
    for k, name in enumerate(tasks):
        # One word a line: eight long names fit side by side.
        axes.annotate(
            name.replace("_", "\n").replace("-", "-\n"),
            xy=((k + 0.5) * budget, 1.0),
            xytext=(0, 5),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=size,
            linespacing=1.05,
        )
