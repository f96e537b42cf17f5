"""The paper's comparison of its modes with pink noise, both ways to explore better.

Pink noise (Eberhard et al., ICLR 2023) is correlated in time: an action's noise pushes
to one side for longer.
"""

from experiments import first_task, suite
from experiments.first_task import FirstTask
from rewire_jax import tables
from rewire_jax.rundata import read_run
from rewire_jax.summary import spread

# Two of the runs are Figure 5's.
VARIANTS: suite.Variants = {
    "ft1": ("ft1", {}),
    "ft1-pink": ("ft1", {"sac": {"noise_color": 1.0}}),
    "rewire": ("rewire", {}),
}
LABELS = {"ft1": "FT-1", "ft1-pink": "FT-1, pink noise", "rewire": "Ours"}


def tell(run: suite.Run) -> str:
    """A run's evaluation after the first task, in Markdown."""
    data = read_run(run.folder)
    # `[seeds, stages, tasks]`.
    returns = tables.spread(spread(data.scores[data.kept, 0, 0]))
    return f"- {LABELS[run.folder.name]}: **{returns}**"


def run(job: FirstTask) -> None:
    """Trains what is not finished, and draws the curves.

    Raises:
      UserError: wrong arguments.
      rewire_jax.Stopped: interrupted; the same command goes on.
    """
    runs = suite.train(job.runs(job.scenario, VARIANTS), job)
    found = first_task.read("Pink noise", runs, LABELS)
    notes = (
        "Training returns are those of exploring actions. Evaluated without noise "
        "after the task, mean ± sample standard deviation over seeds:",
        "",
        *map(tell, runs),
        "",
    )
    path = job.folder("pink-noise") / "pink-noise"
    first_task.write(path, "training return", found, [list(LABELS)], notes)


if __name__ == "__main__":
    suite.command(FirstTask, run, "pink_noise")
