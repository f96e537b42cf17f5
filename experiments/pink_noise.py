"""The paper's comparison of exploration by modes with exploration by pink noise.

Pink noise (Eberhard et al., ICLR 2023) is correlated in time, so the noise of an action
keeps its sign for longer.
"""

from experiments import first_task, suite
from experiments.first_task import FirstTask, Trained
from rewire_jax.reports.spread import spread

VARIANTS: suite.Variants = {
    "ft1-white": ("ft1", {"sac": {"noise_color": 0.0}}),
    "ft1-pink": ("ft1", {"sac": {"noise_color": 1.0}}),
    "rewire-white": ("rewire", {"sac": {"noise_color": 0.0}}),
}
LABELS = {"ft1-white": "FT-1", "ft1-pink": "FT-1, pink noise", "rewire-white": "Ours"}


def tell(trained: Trained) -> str:
    """Evaluations after the first task, in Markdown."""
    return f"- {trained.curve.label}: **{spread(trained.returns)}**"


def run(job: FirstTask) -> None:
    """Trains what is unfinished, and draws it; raises as `suite.train`."""
    evolved = first_task.train(job, "Pink noise", VARIANTS, LABELS)
    notes = (
        "Training returns are those of exploring actions. Evaluated without noise "
        "after the task, mean ± sample standard deviation over seeds:",
        "",
        *map(tell, evolved.found.values()),
        "",
    )
    path = job.folder("pink-noise") / "pink-noise"
    first_task.write(path, "training return", evolved, [list(LABELS)], notes)


if __name__ == "__main__":
    suite.command(FirstTask, run, "pink_noise")
