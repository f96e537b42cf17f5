"""Picture of what training goes through, the paper's Fig. 3 and 5."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import EngFormatter, StrMethodFormatter

from rewire_jax.reports.plots import Array, empty, entitle, look
from rewire_jax.reports.statistics import mean, stratified_bootstrap

_READING = (
    "lines: median over seeds, bands: 95% bootstrap interval of the mean, {} seeds"
)


class Curve(NamedTuple):
    """A quantity over training.

    Attributes:
        label: what was trained.
        x: interactions, `[points]`.
        values: `[seeds, points]`, NaN where there is none.
    """

    label: str
    x: Array
    values: Array

    @property
    def median(self) -> Array:
        """Over seeds, `[points]`."""
        return np.median(self.values, axis=0)

    @property
    def mean(self) -> Array:
        """Over seeds, `[points]`."""
        return np.mean(self.values, axis=0)

    @property
    def interval(self) -> Array:
        """Ends of the mean's 95% bootstrap interval, `[2, points]`.

        NaN where a value is missing, or with fewer than two seeds, which say nothing
        of the spread.
        """
        ends = np.full((2, self.x.size), np.nan)
        for i, point in enumerate(self.values.T):
            if len(point) > 1 and not np.isnan(point).any():
                ends[:, i] = stratified_bootstrap(mean, point[:, None])
        return ends


def evolution(
    panels: Sequence[Sequence[Curve]],
    quantity: str,
    title: str,
    path: Path,
    *,
    log: bool = False,
) -> None:
    """Writes curves over training, panels side by side and with the same scale.

    A curve has the same look in every panel; its label tells it from the others.

    Args:
        panels: the curves of each.
        quantity: what the values are.
        title: above the picture.
        path: the PNG file to write.
        log: of the values; those not above 0 are left out.
    """
    figure, drawn = empty((max(8.0, 6.0 * len(panels)), 5.0), 1, len(panels))
    labels = list(dict.fromkeys(curve.label for panel in panels for curve in panel))
    for axes, panel in zip(drawn, panels, strict=True):
        if axes is not drawn[0]:
            axes.sharey(drawn[0])
        for curve in panel:
            style = look(labels.index(curve.label))
            middle, (low, high) = curve.median, curve.interval
            if log:
                axes.set_yscale("log")
                middle = np.where(middle > 0, middle, np.nan)
                low = np.where(low > 0, low, np.nan)
            axes.fill_between(
                curve.x, low, high, color=style["color"], alpha=0.2, linewidth=0
            )
            axes.plot(curve.x, middle, **style, label=curve.label)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if not log:
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
        axes.set_xlabel("training interactions, each seed")
        axes.set_ylabel(quantity)
        axes.grid(axis="y", color="0.9")
        axes.set_axisbelow(True)
        axes.legend(frameon=False)
    counts = sorted({len(curve.values) for panel in panels for curve in panel})
    entitle(figure, title, _READING.format(" to ".join(map(str, counts))))
    figure.savefig(path)
