"""Writes run folders with known numbers, for the tests of what reads them."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

TASKS = ("hugefoot", "moon", "carry_stuff")
BUDGET = 1000
# Row 0 before any training, then after training task 0, 1, 2; seed 0 of two.
SCORES = np.array([[1, 2, 3], [1000, 50, 40], [700, 2000, 60], [400, 1500, 3000]])
GAP = 200  # what seed 1 scores above seed 0


def write_run(
    folder: Path,
    *,
    method: str = "rewire",
    seeds: int = 2,
    stages: int = 3,
    diverged: tuple[int, ...] = (),
    tasks: Sequence[str] = TASKS,
    scores: np.ndarray = SCORES,
    size: float = 1.5,
    **settings: Any,
) -> Path:
    """A run folder with `stages` tasks trained."""
    folder.mkdir(parents=True)
    head = {
        "format": 1,
        "settings": {
            "scenario": "halfcheetah/forgetting",
            "method": method,
            "profile": "quick",
            "backend": "positional",
            "seed": 0,
            "seeds": seeds,
            "interactions": BUDGET,
            **settings,
        },
        "tasks": tasks,
        "episode_length": 10,
        "model_size": {"numbers": 9, "ratio": 2.11},
        "provenance": {
            "command": "rewire-jax train",
            "commit": "abc123",
            "versions": {"jax": "0.10.2"},
            "device": "cpu",
            "started": "2025-01-01T00:00:00",
        },
    }
    (folder / "settings.json").write_text(json.dumps(head))
    results = [
        {
            "stage": stage,
            "task": task,
            "name": tasks[task],
            "seed": seed,
            "return": float("nan")
            if seed in diverged
            else float(scores[stage + 1, task] + GAP * seed),
            "episodes": 10,
            "interactions": {"training": BUDGET * (stage + 1), "selection": 77},
            "diverged": seed in diverged and stage >= 0,
            "model_size": size + 0.25 * (stage + 1),
        }
        for stage in range(-1, stages)
        for task in range(len(tasks))
        for seed in range(seeds)
    ]
    chunks = [(stage, x) for stage in range(stages) for x in (250, 500, 1000)]
    training = [
        {
            "stage": stage,
            "seed": seed,
            "interactions": x,
            "return": None,
            "reward": None if x == 250 else (x * (stage + 1) + 300 * seed) / 10,
            "critic_loss": 0.5,
        }
        for stage, x in chunks
        for seed in range(seeds)
    ]
    timing = [
        {
            "stage": stage,
            "interactions": x,
            "seconds": 60.0 if x == 250 else x / 500,
            "compile": x == 250,
        }
        for stage, x in chunks
    ]
    for name, rows in (
        ("results", results),
        ("training", training),
        ("timing", timing),
    ):
        lines = "".join(json.dumps(row) + "\n" for row in rows)
        (folder / f"{name}.jsonl").write_text(lines)
    return folder


def replace_line(path: Path, number: int, text: str) -> None:
    lines = path.read_text().split("\n")
    lines[number - 1] = text
    path.write_text("\n".join(lines))
