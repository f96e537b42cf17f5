"""Picture of performance profiles, as in Agarwal et al. (NeurIPS 2021)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter, StrMethodFormatter

from rewire_jax.reports.plots import GREY, Array, entitle, methods_figure


class Profile(NamedTuple):
    """A method's performance profile.

    Attributes:
        label: the method.
        shares: share of scores above each threshold, `[thresholds]`; None without
            scores.
        interval: its ends, `[2, thresholds]`; None where there is none.
    """

    label: str
    shares: Array | None
    interval: Array | None


def profiles(
    lines: Sequence[Profile], thresholds: Array, unit: str, title: str, path: Path
) -> None:
    """Writes the profiles of methods, with their intervals as bands.

    Args:
        lines: one for each method, in the order of the other pictures.
        thresholds: scores, `[thresholds]`.
        unit: what scores are measured in.
        title: above the picture.
        path: the PNG file to write.
    """

    def draw(axes: Axes, place: int, style: Mapping[str, Any], band: float) -> None:
        line = lines[place]
        if line.shares is None:
            return
        axes.plot(thresholds, line.shares, **style)
        if band and line.interval is not None:
            axes.fill_between(
                thresholds, *line.interval, color=style["color"], alpha=band, lw=0
            )

    labels = [line.label for line in lines]
    figure, panels = methods_figure(labels, (9.0, 5.0), draw)
    for axes in panels:
        axes.grid(color="0.9")
        axes.set_axisbelow(True)
    first = panels[0]
    first.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    first.yaxis.set_major_formatter(PercentFormatter(1.0))
    first.set_xlim(thresholds[0], thresholds[-1])
    first.set_ylim(-0.02, 1.02)
    figure.supxlabel(f"score at the end ({unit})", fontsize=10)
    figure.supylabel("share of seeds and tasks above it", fontsize=10)
    reading = "higher is better"
    if any(line.interval is not None for line in lines):
        reading += "; bands: 95% bootstrap intervals"
    entitle(figure, title, reading + (GREY if len(panels) > 1 else ""))
    figure.savefig(path)
