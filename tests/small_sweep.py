"""Sweeps of seconds."""

import dataclasses
import json
from pathlib import Path

from rewire_jax.core.settings import Settings
from rewire_jax.run import sweep
from tests.tiny import tiny


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
