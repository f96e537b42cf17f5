"""The paper's Figure 5: training on the first task with and without the designs.

Figure 3 is made from two of the same runs.
"""

from dataclasses import dataclass

from experiments import suite

# Names are those of the other experiments' runs. On the first task there is nothing to
# align with: what Table 3 calls aligned is rewiring alone.
VARIANTS: suite.Variants = {
    "rewire": ("rewire", {}),
    "rewire-undistilled": ("rewire", {"alpha": 0.0}),
    "ft1": ("ft1", {}),
    "rewire-aligned": ("rewire", {"modes": 1}),
}


@dataclass(frozen=True, kw_only=True)
class Figure5(suite.Experiment):
    """What to run.

    Attributes:
      scenario: name of the scenario.
    """

    scenario: str = "halfcheetah/forgetting"
    tasks: int = 1


def run(job: Figure5) -> None:
    """Trains what is not finished.

    Raises:
      UserError: wrong arguments.
      rewire_jax.Stopped: interrupted; the same command goes on.
    """
    suite.train(job.runs(job.scenario, VARIANTS), job)


if __name__ == "__main__":
    suite.command(Figure5, run, "figure5_evolution")
