"""The paper's Figure 3: divergence between the modes' policies during the first task.

In the paper the modes diverge and then converge, earlier with distillation. The plot
shows the KL divergence, averaged over all pairs of modes and over states from the
buffer, without the noise on the scores.
"""

from typing import NamedTuple

import numpy as np

from experiments import first_task, suite
from experiments.figure5_evolution import VARIANTS
from experiments.first_task import FirstTask
from rewire_jax.core.formatting import number
from rewire_jax.reports.plots import Array
from rewire_jax.reports.training_curve_plot import Curve

LABELS = {"rewire": "with L_KL", "rewire-undistilled": "without L_KL"}
QUANTITY = "KL divergence between modes"


class Pattern(NamedTuple):
    """The course of a curve: medians over a tenth of the reports.

    Means do not work here: one state in which a mode is nearly deterministic can make
    the divergence in a report a thousand times larger than in the next report.

    Attributes:
      at: interactions around which it is highest.
      peak: its value there.
      end: its value at the end.
    """

    at: float
    peak: float
    end: float

    @property
    def share(self) -> float:
        """What is left of the peak at the end."""
        return self.end / self.peak if self.peak > 0 else 1.0

    @property
    def converges(self) -> bool:
        """Whether that is less than half."""
        return self.share < 0.5


def pattern(x: Array, values: Array, window: int) -> Pattern:
    """What becomes of the values `[points]` at these interactions."""
    over, middle = (
        np.median(np.lib.stride_tricks.sliding_window_view(each, window), axis=-1)
        for each in (x, values)
    )
    highest = np.nanargmax(middle)
    return Pattern(over[highest], middle[highest], middle[-1])


def tell(curve: Curve) -> str:
    """Whether modes diverge and converge, in Markdown."""
    window = first_task.tenth(curve)
    median = pattern(curve.x, curve.median, window)
    seeds = [pattern(curve.x, values, window).converges for values in curve.values]
    return (
        f"- {curve.label}: diverge-and-converge "
        f"**{'appears' if median.converges else 'does not appear'}** in the median "
        f"over seeds, and appears in {sum(seeds)} of {len(seeds)} seeds. The median "
        "over seeds, smoothed over a tenth of the reports, peaks at "
        f"{number(median.peak)} near {median.at:,.0f} interactions. It ends at "
        f"{number(median.end)}, {median.share:.0%} of the peak."
    )


def run(job: FirstTask) -> None:
    """Trains what is unfinished, and draws it; raises as `suite.train`."""
    variants = {name: VARIANTS[name] for name in LABELS}
    evolved = first_task.train(job, "Figure 3", variants, LABELS, "mode_divergence")
    notes = (
        "We say that diverge-and-converge appears if the divergence at the end is "
        "below half of its peak. Both values are medians over a tenth of the progress "
        "reports.",
        "",
        *(tell(trained.curve) for trained in evolved.found.values()),
        "",
    )
    path = job.folder("figure3") / "figure3"
    first_task.write(path, QUANTITY, evolved, [list(LABELS)], notes, log=True)


if __name__ == "__main__":
    suite.command(FirstTask, run, "figure3_mode_kl")
