"""Does a policy that has met a dead leg still walk as before?"""

import dataclasses
from pathlib import Path
from typing import Any

import rewire_jax
from rewire_jax import ScenarioSpec, TaskChange

SPEC = ScenarioSpec(
    name="ant/limping",
    domain="ant",
    changes=(
        TaskChange("normal"),
        TaskChange("limp", actions={"hip_1": 0.0, "ankle_1": 0.0}),
    ),
    repeats=1,
    interactions=100_000,
)


def compare(out: Path, profile: str = "quick", **changes: Any) -> Path:
    """Trains three methods, and writes their report; returns its Markdown."""
    scenario = rewire_jax.make_scenario(SPEC)
    runs = []
    for method in ("rewire", "ft1", "sac_n"):
        settings = rewire_jax.preset(scenario, method, profile)
        settings = dataclasses.replace(settings, **changes)
        run = out / method
        rewire_jax.train(settings, run, scenario=scenario, resume=run.exists())
        runs.append(run)
    return rewire_jax.write_report(runs, out / "report").page


if __name__ == "__main__":
    print(compare(Path("runs/limping"), seeds=2, interactions=100_000))
