"""Settings of a run of seconds, and the rows that it writes."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

import rewire_jax
from rewire_jax.core.settings import Settings
from rewire_jax.envs.scenarios import Scenario, make_scenario

# SAC's own defaults in place of the quick profile's values, which suit a HalfCheetah.
PLAIN = {
    "reward_scale": 1.0,
    "discount": 0.99,
    "target_rate": 0.005,
    "critic_entropy": "sample",
    "policy_states": "current",
    "noise_color": 0.0,
}


def tiny(scenario: str | Scenario = "probe/reach", method: str = "rewire") -> Settings:
    if isinstance(scenario, str):
        scenario = make_scenario(scenario)
    quick = rewire_jax.preset(scenario, method, "quick")
    return small(dataclasses.replace(quick, seeds=2))


def small(settings: Settings) -> Settings:
    """The same with budgets of seconds."""
    return dataclasses.replace(
        settings,
        interactions=640,
        envs=16,
        updates=4,
        warmup=160,
        eval_episodes=4,
        selection_episodes=2,
        report_every=160,
        checkpoint_every=320,
        sac=dataclasses.replace(
            settings.sac, hidden=16, depth=2, batch_size=32, **PLAIN
        ),
    )


def shrink_presets(
    monkeypatch: pytest.MonkeyPatch, hidden: int, **changes: Any
) -> None:
    """Makes presets those of a run of seconds, with a single hidden layer."""
    preset = rewire_jax.preset
    few = {"envs": 16, "warmup": 160, "eval_episodes": 2, "report_every": 160}

    def shrunk(*arguments: Any) -> Settings:
        quick = preset(*arguments)
        sac = dataclasses.replace(quick.sac, hidden=hidden, depth=1, batch_size=8)
        return dataclasses.replace(quick, sac=sac, **few | changes)

    monkeypatch.setattr(rewire_jax, "preset", shrunk)


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
    names = ("hidden", "depth", "batch_size", *PLAIN)
    values |= {name: getattr(settings.sac, name) for name in names}
    return [w for n, v in values.items() for w in ("--" + n.replace("_", "-"), str(v))]


def rows(folder: Path, table: str = "results.jsonl") -> list[dict[str, Any]]:
    """The rows of a table of a run."""
    return [json.loads(line) for line in (folder / table).read_text().splitlines()]
