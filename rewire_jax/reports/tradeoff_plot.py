"""Picture of performance against model size, the paper's Fig. 4."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import StrMethodFormatter
from matplotlib.transforms import Bbox

from rewire_jax.reports.plots import empty, entitle, look

_MARKER = 7  # half of a marker and the air around it, in pixels
_RIGHT_FIRST = np.radians([0, 30, -30, 180, 150, -150, 60, -60, 120, -120, 90, -90])


class Point(NamedTuple):
    """A method's place in the picture.

    Attributes:
        label: the method.
        size: model size in plain policies.
        mean: performance over seeds; NaN leaves the point out.
        std: its standard deviation, None with fewer than two seeds.
    """

    label: str
    size: float
    mean: float
    std: float | None


def tradeoff(points: Sequence[Point], unit: str, title: str, path: Path) -> None:
    """Writes performance against model size, a labelled point for each method.

    Args:
        points: one for each method, in the order of the other pictures.
        unit: what performance is measured in.
        title: above the picture.
        path: the PNG file to write.
    """
    figure, (axes,) = empty((8.0, 5.6), 1, 1)
    shown = [(i, point) for i, point in enumerate(points) if not np.isnan(point.mean)]
    for i, point in shown:
        axes.errorbar(
            point.size,
            point.mean,
            yerr=point.std,
            color=look(i)["color"],
            marker="o",
            markersize=8,
            capsize=3,
            linewidth=1.3,
        )
    axes.set_xlabel("model size (plain policies), smaller is better")
    axes.set_ylabel(f"performance at the end ({unit})")
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    axes.margins(0.12)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    spread = any(point.std is not None for _, point in shown)
    entitle(figure, title, "bars: standard deviation over seeds" if spread else "")
    _write_labels(figure, axes, shown)
    figure.savefig(path)


def place(
    points: np.ndarray, sizes: np.ndarray, taken: Sequence[Bbox], area: Bbox
) -> list[Bbox]:
    """Boxes near their points that overlap neither each other nor what is taken.

    Args:
        points: `[n, 2]`, in pixels.
        sizes: `[n, 2]`, width and height of each box.
        taken: what no box may cover.
        area: where boxes belong.

    Returns:
        A box for each point, the nearest free one; beyond the reach of 400 pixels,
        any.
    """
    boxes: list[Bbox] = []
    for point, size in zip(points, sizes, strict=True):
        box = Bbox([[0, 0], [0, 0]])
        for reach, angle in itertools.product(range(4, 400, 8), _RIGHT_FIRST):
            way = np.array([np.cos(angle), np.sin(angle)])
            middle = point + way * (_MARKER + reach + size / 2)
            box = Bbox([middle - size / 2, middle + size / 2])
            inside = area.containsx(box.x0) and area.containsx(box.x1)
            inside &= area.containsy(box.y0) and area.containsy(box.y1)
            if inside and not box.count_overlaps([*taken, *boxes]):
                break
        boxes.append(box)
    return boxes


def _write_labels(
    figure: Figure, axes: Axes, shown: Sequence[tuple[int, Point]]
) -> None:
    """Names the points; a thin line leads from a name to its point."""
    # Pixels hold only once the layout has been made and is left as it is.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    values = np.array([(point.size, point.mean) for _, point in shown]).reshape(-1, 2)
    half = np.array([(0.0, point.std or 0.0) for _, point in shown]).reshape(-1, 2)
    low, high = (axes.transData.transform(values + s * half) for s in (-1, 1))
    taken = [Bbox([a - _MARKER, b + _MARKER]) for a, b in zip(low, high, strict=True)]
    texts = [
        axes.annotate(
            point.label,
            xy=(point.size, point.mean),
            xytext=(0, 0),
            textcoords="figure pixels",
            ha="center",
            va="center",
            fontsize=10,
            color=look(i)["color"],
            arrowprops={
                "arrowstyle": "-",
                "color": look(i)["color"],
                "linewidth": 0.6,
                "shrinkB": 5,
            },
        )
        for i, point in shown
    ]
    extents = [Text.get_window_extent(text) for text in texts]  # without the line
    sizes = np.array([(box.width, box.height) for box in extents]).reshape(-1, 2)
    for text, box in zip(
        texts,
        place(axes.transData.transform(values), sizes, taken, axes.bbox),
        strict=True,
    ):
        text.set_position(((box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2))
