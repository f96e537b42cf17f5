"""The paper's Figure 3: how far the modes' policies are apart during the first task.

The paper sees them diverge and then converge, sooner with distillation. What is shown
is the KL divergence over all pairs of modes and over states from the buffer, without
the noise that exploration and distillation add.
"""

from typing import NamedTuple

import numpy as np

from experiments import first_task, suite
from experiments.figure5_evolution import VARIANTS
from experiments.first_task import FirstTask
from rewire_jax.evolution import Curve
from rewire_jax.figures import Array, number

LABELS = {"rewire": "with L_KL", "rewire-undistilled": "without L_KL"}
QUANTITY = "KL divergence between modes"


class Pattern(NamedTuple):
    """What becomes of a curve, told by its means over a tenth of the reports.

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
    over, means = (
        np.lib.stride_tricks.sliding_window_view(each, window).mean(axis=-1)
        for each in (x, values)
    )
    highest = np.nanargmax(means)
    return Pattern(over[highest], means[highest], means[-1])


def tell(curve: Curve) -> str:
    """Whether modes diverge and converge, in Markdown."""
    window = first_task.tenth(curve)
    mean = pattern(curve.x, curve.mean, window)
    seeds = [pattern(curve.x, values, window).converges for values in curve.values]
    return (
        f"- {curve.label}: diverge-and-converge "
        f"**{'appears' if mean.converges else 'does not appear'}** in the mean, and "
        f"appears in {sum(seeds)} of {len(seeds)} seeds. The mean is highest around "
        f"{mean.at:,.0f} interactions, {number(mean.peak)}, and {number(mean.end)} at "
        f"the end, {mean.share:.0%} of that."
    )


def run(job: FirstTask) -> None:
    """Trains what is not finished, and draws the figure.

    Raises:
      UserError: wrong arguments.
      rewire_jax.Stopped: interrupted; the same command goes on.
    """
    variants = {name: VARIANTS[name] for name in LABELS}
    runs = suite.train(job.runs(job.scenario, variants), job)
    found = first_task.read("Figure 3", runs, LABELS, "mode_divergence")
    notes = (
        "Diverge-and-converge is said to appear where the divergence ends below half "
        "of its peak, both taken over a tenth of the progress reports.",
        "",
        *map(tell, found.curves.values()),
        "",
    )
    path = job.folder("figure3") / "figure3"
    first_task.write(path, QUANTITY, found, [list(LABELS)], notes, log=True)


if __name__ == "__main__":
    suite.command(FirstTask, run, "figure3_mode_kl")
