"""Which short regime learns to run: FT-1 on the first task, one regime a row.

A regime changes `BASE`: its environments, interactions, updates, and some of SAC's
settings. The table shows which budget a policy needs to stand up. It gave the settings
of the quick profile.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from experiments import first_task, suite
from experiments.first_task import Trained
from rewire_jax.core.arguments import require
from rewire_jax.core.formatting import number
from rewire_jax.reports.provenance import origin
from rewire_jax.storage.run_results import RunData, read_run

SCENARIO = "halfcheetah/forgetting"
BASE = {"envs": 32, "updates": 16, "interactions": 38_400, "warmup": 2_560}
BASE |= {"report_every": 2_560, "eval_episodes": 32, "checkpoint_every": 0}
BASE_SAC = {"batch_size": 256, "reward_scale": 1.0, "discount": 0.99}
BASE_SAC |= {"target_rate": 0.005, "noise_color": 0.0, "initial_temperature": 0.1}
AVERAGED = {"critic_entropy": "batch_mean", "policy_states": "both"}
SCALED = AVERAGED | {"reward_scale": 10.0}
HALF = {"envs": 64, "interactions": 76_800, "warmup": 5_120, "report_every": 6_400}
MANY = {"envs": 128, "interactions": 153_600, "warmup": 10_240, "report_every": 12_800}
LONG = MANY | {"interactions": 307_200}
DOUBLE = MANY | {"updates": 32}
FEW = {"updates": 8, "interactions": 153_600, "warmup": 5_120, "report_every": 6_400}
WARM, SMALL = {"initial_temperature": 1.0}, {"batch_size": 128}
QUICK, SLOW, PINK = {"discount": 0.97}, {"target_rate": 0.02}, {"noise_color": 1.0}
REGIMES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "envs-32": ({}, AVERAGED),
    "envs-32-scale-10": ({}, SCALED),
    "envs-64": (HALF, AVERAGED),
    "envs-128": (MANY, AVERAGED),
    "envs-128-width-64": (MANY, AVERAGED | {"hidden": 64}),
    "envs-128-temperature-1": (MANY, AVERAGED | WARM),
    "envs-128-temperature-1-long": (LONG, AVERAGED | WARM),
    "envs-128-policy-rate-3e-4": (MANY, AVERAGED | {"lr_policy": 3e-4}),
    "envs-128-scale-10": (MANY, SCALED),
    "envs-128-scale-10-temperature-1": (MANY, SCALED | WARM),
    "envs-128-scale-10-pink": (MANY, SCALED | PINK),
    "envs-128-scale-10-discount-0.97": (MANY, SCALED | QUICK),
    "envs-128-scale-10-target-rate-0.02": (MANY, SCALED | SLOW),
    "envs-128-scale-10-pink-discount-target-rate": (MANY, SCALED | QUICK | SLOW | PINK),
    "envs-128-scale-10-policy-delay-1": (MANY, SCALED | {"policy_delay": 1}),
    "envs-128-scale-10-batch-128": (DOUBLE, SCALED | SMALL),
    "envs-32-scale-10-batch-128": (FEW, SCALED | SMALL),
    "envs-32-scale-10-batch-128-discount-target-rate": (
        FEW,
        SCALED | SMALL | QUICK | SLOW,
    ),
    "envs-32-scale-10-batch-128-pink-discount-target-rate": (
        FEW,
        SCALED | SMALL | QUICK | SLOW | PINK,
    ),
    "envs-32-batch-128": (FEW, AVERAGED | SMALL),
    "envs-32-scale-3-batch-128": (FEW, AVERAGED | SMALL | {"reward_scale": 3.0}),
}
"""Changes of `BASE`, and of `BASE_SAC`."""
HEAD = ["regime", "interactions", "updates", "seeds"]
HEAD += ["training return, each seed", "without exploration, each seed"]
READING = (
    "All regimes have a reduced budget (paper: 1,000,000 interactions). All use "
    "`--critic-entropy batch_mean --policy-states both`. In their names, envs is "
    "`--envs`, scale `--reward-scale`, width `--hidden`, temperature "
    "`--initial-temperature`, pink `--noise-color 1`, discount `--discount 0.97`, "
    "target-rate `--target-rate 0.02`, batch `--batch-size`. The training return is "
    "the mean over the last whole episode."
)


@dataclass(frozen=True, kw_only=True)
class Regimes(suite.Experiment):
    """What to run.

    Attributes:
      regimes: names of the regimes; all if empty.
    """

    regimes: tuple[str, ...] = ()
    tasks: int = 1

    def all(self) -> dict[str, list[suite.Run]]:
        """The runs of each chosen regime, one for each seed."""
        unknown = set(self.regimes) - set(REGIMES)
        require(
            not unknown,
            f"--regimes {' '.join(unknown)}: choose from {', '.join(REGIMES)}",
        )
        seeds = range(self.seed, self.seed + self.seeds)
        names = self.regimes or tuple(REGIMES)
        return {name: [self.one(name, seed) for seed in seeds] for name in names}

    def one(self, name: str, seed: int) -> suite.Run:
        """The run of a regime with a seed."""
        changes, sac = REGIMES[name]
        folder = self.out / "quick-regime" / name / f"seed-{seed}"
        single = replace(self, seed=seed, seeds=1)
        scenario = self.scenario_of(SCENARIO)
        run = single.run(scenario, "ft1", folder, BASE_SAC | sac)
        settings = replace(run.settings, **BASE | changes)
        return run._replace(settings=settings)


def row(name: str, runs: Sequence[RunData], trained: Trained) -> list[str]:
    """A regime's cells."""
    settings: dict[str, Any] = runs[0].settings
    begun = settings["interactions"] - settings["warmup"]
    updates = begun // settings["envs"] * settings["updates"]
    return [
        name,
        f"{settings['interactions']:,}",
        f"{updates:,}",
        ", ".join(map(str, trained.seeds)),
        ", ".join(map(number, trained.end)),
        ", ".join(map(number, trained.returns)),
    ]


def run(job: Regimes) -> None:
    """Trains what is unfinished, and writes the table; raises as `suite.train`."""
    regimes = job.all()
    suite.train([run for runs in regimes.values() for run in runs], job)
    rows, numbers, origins = [HEAD], [], []
    for name, runs in regimes.items():
        done = [read_run(run.folder) for run in runs if run.finished]
        if not done:
            continue
        trained = first_task.gather(name, done)
        rows.append(row(name, done, trained))
        origins.append(origin(name, *done))
        ends = zip(trained.seeds, trained.end, trained.returns, strict=True)
        numbers += [
            {"regime": name, "seed": seed, "training": end, "deterministic": after}
            for seed, end, after in ends
        ]
    require(bool(numbers), "none of the runs has ended")
    backend = job.scenario_of(SCENARIO).backend
    place = f"the first task of {SCENARIO}, {backend} backend"
    title = f"Short training settings: FT-1 on {place}"
    path = job.folder("quick-regime") / "quick-regime"
    suite.write(path, title, rows, ["", READING, "", *origins], numbers)


if __name__ == "__main__":
    suite.command(Regimes, run, "quick_regime")
