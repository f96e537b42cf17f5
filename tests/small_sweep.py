"""Sweeps of seconds."""

import dataclasses
import json
from pathlib import Path

import pytest

from rewire_jax.core.settings import Settings
from rewire_jax.run import sweep
from tests.tiny import flags, tiny

GRID: dict[str, list[float]] = {
    "modes": [1, 2, 3, 4],
    "alpha": [0, 1e-2],
    "beta": [0.1, 1, 10],
}


def small(**changes) -> Settings:
    """Settings of a member; a width of its own, so that its traces are counted here."""
    settings = dataclasses.replace(
        tiny(),
        seeds=1,
        tasks=2,
        interactions=320,
        envs=8,
        warmup=80,
        report_every=80,
        checkpoint_every=160,
        eval_episodes=2,
    )
    sac = dataclasses.replace(settings.sac, hidden=14, depth=1, batch_size=16)
    return dataclasses.replace(settings, sac=sac, **changes)


def rows(folder: Path, table: str = "results.jsonl") -> dict[tuple, dict]:
    """Rows of all batches by stage, member and the rest of their place."""
    rest = "task" if table == "results.jsonl" else "interactions"
    found = {}
    for path in folder.glob(f"task-*/batch-*/{table}"):
        for line in path.read_text().splitlines():
            row = json.loads(line)
            found[row["stage"], row["member"], row[rest]] = row
    return found


def run_sweep(folder: Path, settings: Settings, **options) -> Path:
    return sweep.sweep(settings, folder, **options)


def sweep_words(out: Path, *more: str, most: int = 12) -> list[str]:
    """What gives the `rewire-jax` command a sweep of the grid, in two batches."""
    words = ["sweep", "probe/reach", *flags(small()), "--out", str(out)]
    words += ["--members-per-batch", str(most)]
    words += ["--modes", *map(str, GRID["modes"]), "--alpha", *map(str, GRID["alpha"])]
    return [*words, "--axis", "beta", *map(str, GRID["beta"]), *more]


def near(ours: dict[tuple, dict], theirs: dict[tuple, dict]) -> None:
    """The same rows, with numbers that differ as float sums in another order."""
    assert ours.keys() == theirs.keys()
    for place, row in ours.items():
        assert row.keys() == theirs[place].keys()
        for name, value in row.items():
            other = theirs[place][name]
            if isinstance(value, float):
                other = pytest.approx(other, rel=2e-3, abs=2e-3)
            assert value == other, (place, name)
