"""Picture of performance profiles, as in Agarwal et al. (NeurIPS 2021)."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.ticker import PercentFormatter, StrMethodFormatter

from rewire_jax.reports.plots import Array, empty, entitle, look


class Profile(NamedTuple):
    """A method's performance profile.

    Attributes:
        label: the method.
        shares: share of scores above each threshold, `[thresholds]`.
        interval: its ends, `[2, thresholds]`; None where there is none.
    """

    label: str
    shares: Array
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
    figure, (axes,) = empty((9.0, 5.0), 1, 1)
    for i, line in enumerate(lines):
        style = look(i)
        axes.plot(thresholds, line.shares, **style, linewidth=1.6, label=line.label)
        if line.interval is not None:
            axes.fill_between(
                thresholds, *line.interval, color=style["color"], alpha=0.12, lw=0
            )
    axes.set_xlabel(f"score at the end ({unit})")
    axes.set_ylabel("share of seeds and tasks above it")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlim(thresholds[0], thresholds[-1])
    axes.set_ylim(-0.02, 1.02)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    figure.legend(loc="outside right center", frameon=False)
    entitle(figure, title, "higher is better; bands: 95% bootstrap intervals")
    figure.savefig(path)
