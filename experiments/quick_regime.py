"""Which short regime learns to run: FT-1 on the first task, one regime a row.

A regime is a number of environments, of interactions and of updates, a batch and some
of SAC's settings. Used to choose the quick profile's values.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments import suite
from rewire_jax.core.formatting import number
from rewire_jax.core.settings import require
from rewire_jax.reports.provenance import origin
from rewire_jax.storage.run_results import RunData, read_run

SCENARIO = "halfcheetah/forgetting"
AVERAGED = {"critic_entropy": "batch_mean", "policy_states": "both"}
SCALED = AVERAGED | {"reward_scale": 10.0}
MANY = {"envs": 128, "interactions": 153_600, "warmup": 10_240, "report_every": 12_800}
HALF = {"envs": 64, "interactions": 76_800, "warmup": 5_120, "report_every": 6_400}
FEW = {"updates": 8, "interactions": 153_600, "warmup": 5_120, "report_every": 6_400}
SMALL = {"batch_size": 128}
REGIMES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "averaged": ({}, AVERAGED),
    "averaged, scale 10": ({}, SCALED),
    "64 environments": (HALF, AVERAGED),
    "128 environments": (MANY, AVERAGED),
    "width 64": (MANY, AVERAGED | {"hidden": 64}),
    "temperature 1": (MANY, AVERAGED | {"initial_temperature": 1.0}),
    "twice as long": (
        MANY | {"interactions": 307_200},
        AVERAGED | {"initial_temperature": 1.0},
    ),
    "policy's rate 3e-4": (MANY, AVERAGED | {"lr_policy": 3e-4}),
    "scale 10": (MANY, SCALED),
    "scale 10, temperature 1": (MANY, SCALED | {"initial_temperature": 1.0}),
    "pink noise": (MANY, SCALED | {"noise_color": 1.0}),
    "discount 0.97": (MANY, SCALED | {"discount": 0.97}),
    "target rate 0.02": (MANY, SCALED | {"target_rate": 0.02}),
    "all three": (
        MANY,
        SCALED | {"discount": 0.97, "target_rate": 0.02, "noise_color": 1.0},
    ),
    "policy at each update": (MANY, SCALED | {"policy_delay": 1}),
    "batch 128, twice the updates": (MANY | {"updates": 32}, SCALED | SMALL),
    "the same, 32 environments": (FEW, SCALED | SMALL),
    "then scale 1": (FEW, AVERAGED | SMALL),
    "then scale 3": (FEW, AVERAGED | SMALL | {"reward_scale": 3.0}),
}
"""Changes of the quick profile's settings, and of SAC's."""
HEAD = ["regime", "environments", "interactions", "updates", "batch", "seeds"]
HEAD += ["training return, each seed", "without exploration, each seed"]


@dataclass(frozen=True, kw_only=True)
class Regimes(suite.Experiment):
    """What to run.

    Attributes:
      regimes: numbers of the regimes, from 0; all if empty.
    """

    regimes: tuple[int, ...] = ()
    tasks: int = 1

    def all(self) -> list[tuple[str, list[suite.Run]]]:
        """The runs of each chosen regime, one for each seed."""
        scenario = self.scenario_of(SCENARIO)
        wrong = set(self.regimes) - set(range(len(REGIMES)))
        require(not wrong, f"--regimes are 0 to {len(REGIMES) - 1}, not {wrong}")
        made = []
        for place, (name, (changes, sac)) in enumerate(REGIMES.items()):
            if place not in (self.regimes or range(len(REGIMES))):
                continue
            runs = []
            for seed in range(self.seed, self.seed + self.seeds):
                folder = self.out / "quick-regime" / str(place) / f"seed-{seed}"
                run = replace(self, seed=seed, seeds=1).run(
                    scenario, "ft1", folder, sac
                )
                changed = replace(
                    run.settings, eval_episodes=32, checkpoint_every=0, **changes
                )
                runs.append(run._replace(settings=changed))
            made.append((name, runs))
        return made


def ending(run: RunData) -> float:
    """The training return over the last tenth of the reports."""
    values = run.curve[0][1][0]
    return float(np.mean(values[-max(len(values) // 10, 1) :]))


def row(name: str, runs: Sequence[RunData]) -> list[str]:
    """A regime's cells."""
    settings: dict[str, Any] = runs[0].settings
    begun = settings["interactions"] - settings["warmup"]
    updates = begun // settings["envs"] * settings["updates"]
    return [
        name,
        str(settings["envs"]),
        f"{settings['interactions']:,}",
        f"{updates:,}",
        str(settings["sac"]["batch_size"]),
        ", ".join(str(seed) for run in runs for seed in run.seeds),
        ", ".join(number(ending(run)) for run in runs),
        ", ".join(number(float(run.scores[0, 0, 0])) for run in runs),
    ]


def run(job: Regimes) -> None:
    """Trains what is unfinished, and writes the table; raises as `suite.train`."""
    regimes = job.all()
    suite.train([run for _, runs in regimes for run in runs], job)
    rows, numbers, origins = [HEAD], [], []
    for name, runs in regimes:
        done = [read_run(run.folder) for run in runs if run.finished]
        if not done:
            continue
        rows.append(row(name, done))
        origins.append(origin(name, *done))
        numbers += [
            {
                "regime": name,
                "seed": data.seeds[0],
                "training": ending(data),
                "deterministic": float(data.scores[0, 0, 0]),
            }
            for data in done
        ]
    require(bool(numbers), "none of the runs has ended")
    backend = regimes[0][1][0].settings.backend
    title = f"Short regimes: FT-1 on the first task of {SCENARIO}, {backend} backend"
    notes = ["", "All are reduced budgets (paper: 1,000,000 interactions).", ""]
    path = job.folder("quick-regime") / "quick-regime"
    suite.write(path, title, rows, [*notes, *origins], numbers)


if __name__ == "__main__":
    suite.command(Regimes, run, "quick_regime")
