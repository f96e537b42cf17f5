"""The paper's Figure 6: performance over K, α and β, in one panel each.

The paper varies each of the three settings while the others have their best values.
This requires all combinations (`--full`). Without `--full`, the other settings have the
profile's values, which requires a sixth of the members. Both are one sweep.
"""

from dataclasses import dataclass
from typing import Any

import rewire_jax
from experiments import suite
from rewire_jax.run.sweep_grid import grid


@dataclass(frozen=True, kw_only=True)
class Figure6(suite.Experiment):
    """What to run.

    Attributes:
      scenario: name of the scenario.
      modes: values of K.
      alpha: weights of the distillation between modes.
      beta: weights of the alignment loss.
      full: train all combinations; otherwise vary one setting at a time.
      members_per_batch: most members trained at the same time; 0 for as many as fit.
    """

    scenario: str = "halfcheetah/forgetting"
    modes: tuple[int, ...] = (1, 2, 3, 4)
    alpha: tuple[float, ...] = (0.0, 1e-6, 1e-5, 1e-4)
    beta: tuple[float, ...] = (0.1, 1.0, 10.0, 100.0)
    full: bool = False
    members_per_batch: int = 0


def configurations(job: Figure6, options: Any) -> list[dict[str, float]]:
    """What is trained: the grid, or the lines through these options."""
    axes = {"modes": job.modes, "alpha": job.alpha, "beta": job.beta}
    if job.full:
        return grid(axes)
    centre = {name: getattr(options, name) for name in axes}
    return [centre] + [
        centre | {name: value}
        for name, values in axes.items()
        for value in values
        if value != centre[name]
    ]


def run(job: Figure6) -> None:
    """Trains what is unfinished, and draws the figure; raises as `suite.train`."""
    scenario = job.scenario_of(job.scenario)
    what = "figure6-grid" if job.full else "figure6-lines"
    folder = job.out / job.name(job.scenario) / what
    made = job.run(scenario, "rewire", folder)
    if job.train:
        rewire_jax.sweep(
            made.settings,
            folder,
            configurations=configurations(job, made.settings.options),
            members_per_batch=job.members_per_batch,
            scenario=scenario,
            resume=made.started,
        )
    out = job.folder(f"{what}-{job.scenario}")
    report = rewire_jax.write_report([folder], out)
    print(report.page.read_text(encoding="utf-8"))
    print(*report.paths, sep="\n")


if __name__ == "__main__":
    suite.command(Figure6, run, "figure6_sensitivity")
