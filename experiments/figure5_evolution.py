"""The paper's Figure 5: training on the first task with and without the designs.

Figure 3 is made from two of the same runs.
"""

from experiments import first_task, suite
from experiments.first_task import FirstTask

# Names are those of the other experiments' runs. On the first task there is nothing to
# align with: what Table 3 calls aligned is rewiring alone.
VARIANTS: suite.Variants = {
    "rewire": ("rewire", {}),
    "rewire-undistilled": ("rewire", {"alpha": 0.0}),
    "ft1": ("ft1", {}),
    "rewire-aligned": ("rewire", {"modes": 1}),
}
LABELS = {
    "ft1": "FT-1",
    "rewire-aligned": "Rewire (K = 1)",
    "rewire": "Ours",
    "rewire-undistilled": "Ours without L_KL",
}
PANELS = (("ft1", "rewire-aligned", "rewire"), ("rewire-undistilled", "rewire"))


def run(job: FirstTask) -> None:
    """Trains what is not finished, and draws the figure.

    Raises:
      UserError: wrong arguments.
      rewire_jax.Stopped: interrupted; the same command goes on.
    """
    runs = suite.train(job.runs(job.scenario, VARIANTS), job)
    found = first_task.read("Figure 5", runs, LABELS)
    notes = (
        "A run's environments start their episodes together, and from rest: the dips.",
        "",
    )
    path = job.folder("figure5") / "figure5"
    first_task.write(path, "training return", found, PANELS, notes)


if __name__ == "__main__":
    suite.command(FirstTask, run, "figure5_evolution")
