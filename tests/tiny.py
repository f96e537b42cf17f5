"""Settings of a run of seconds."""

import dataclasses

from rewire_jax.core.settings import Settings
from rewire_jax.envs.scenarios import Scenario, make_scenario
from rewire_jax.training.presets import preset


def tiny(scenario: str | Scenario = "probe/reach", method: str = "rewire") -> Settings:
    if isinstance(scenario, str):
        scenario = make_scenario(scenario)
    quick = preset(scenario, method, "quick")
    return dataclasses.replace(
        quick,
        seeds=2,
        interactions=640,
        envs=16,
        updates=4,
        warmup=160,
        eval_episodes=4,
        selection_episodes=2,
        report_every=160,
        checkpoint_every=320,
        sac=dataclasses.replace(quick.sac, hidden=16, batch_size=32),
    )


def flags(settings: Settings) -> list[str]:
    """What gives the `rewire-jax` command these settings, after the scenario."""
    names = (
        "method",
        "profile",
        "seeds",
        "tasks",
        "interactions",
        "envs",
        "updates",
        "warmup",
        "eval_episodes",
        "selection_episodes",
        "report_every",
        "checkpoint_every",
    )
    values = {name: getattr(settings, name) for name in names}
    values |= {name: getattr(settings.sac, name) for name in ("hidden", "batch_size")}
    return [w for n, v in values.items() for w in ("--" + n.replace("_", "-"), str(v))]
