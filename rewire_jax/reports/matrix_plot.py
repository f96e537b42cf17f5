"""Picture of the score on every task after every task."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.patches import Rectangle

from rewire_jax.core.formatting import number
from rewire_jax.reports.plots import Array, empty, entitle, grid, mean
from rewire_jax.storage.scores import Score


class Matrix(NamedTuple):
    """A method's evaluations; seeds without a valid result are left out before.

    Attributes:
        label: the method.
        scores: `[seeds, 1 + stages, tasks]`, the first row before any training, NaN
            where there is none.
    """

    label: str
    scores: Array


def matrices(
    lines: Sequence[Matrix], tasks: Sequence[str], score: Score, title: str, path: Path
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
    rows, columns = grid(len(lines))
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
