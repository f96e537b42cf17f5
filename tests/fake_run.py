"""Writes run folders with known numbers, for the tests of what reads them."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

TASKS = ("hugefoot", "moon", "carry_stuff")
BUDGET = 1000
PROVENANCE = {
    "command": "rewire-jax train",
    "commit": "abc123",
    "versions": {"jax": "0.10.2"},
    "device": "cpu",
    "started": "2025-01-01T00:00:00",
}
# Row 0 before any training, then after training task 0, 1, 2; seed 0 of two.
SCORES = np.array([[1, 2, 3], [1000, 50, 40], [700, 2000, 60], [400, 1500, 3000]])
GAP = 200  # what seed 1 scores above seed 0

# On Meta-World, success at any step in the same form. Seed 1 solves 0.1 more; half of
# what is solved at any step is so at the last.
TRIPLET = ("window-close", "handle-press-side", "peg-unplug-side")
RATES = np.array([[0, 0, 0.1], [0.8, 0.2, 0], [0.6, 0.9, 0.1], [0.4, 0.5, 0.7]])
EDGE = 0.1
# Of training episodes at each progress report, by stage; none ended before the first.
LEARNING = np.array([[np.nan, 0.2, 0.6], [np.nan, 0.4, 0.8], [np.nan, 0.0, 0.5]])


def write_run(
    folder: Path,
    *,
    method: str = "rewire",
    seed: int = 0,
    seeds: int = 2,
    stages: int = 3,
    diverged: tuple[int, ...] = (),
    tasks: Sequence[str] = TASKS,
    scores: np.ndarray = SCORES,
    size: float = 1.5,
    stored: float = 0.0,
    rates: np.ndarray | None = None,
    learning: np.ndarray = LEARNING,
    **settings: Any,
) -> Path:
    """A run folder with `stages` tasks trained, with `rates` one that knows success."""

    def success(rate: float, seed: int) -> dict[str, float | None]:
        if rates is None:
            return {}
        if np.isnan(rate):
            return {"success": None, "success_last": None}
        return {
            "success": rate + EDGE * seed,
            "success_last": (rate + EDGE * seed) / 2,
        }

    folder.mkdir(parents=True)
    first, members = seed, range(seed, seed + seeds)
    head = {
        "format": 1,
        "settings": {
            "scenario": "halfcheetah/forgetting",
            "method": method,
            "profile": "quick",
            "backend": "positional",
            "seed": seed,
            "seeds": seeds,
            "interactions": BUDGET,
            "envs": 25,
            **settings,
        },
        "tasks": tasks,
        "episode_length": 10,
        "model_size": {"numbers": 9, "ratio": 2.11},
        "provenance": PROVENANCE,
    }
    (folder / "settings.json").write_text(json.dumps(head))
    results = [
        {
            "stage": stage,
            "task": task,
            "name": tasks[task],
            "member": seed - first,
            "seed": seed,
            "return": None
            if seed in diverged and stage >= 0
            else float(scores[stage + 1, task] + GAP * seed),
            "episodes": 10,
            "interactions": {"training": BUDGET * (stage + 1), "selection": 77},
            "diverged": seed in diverged and stage >= 0,
            "model_size": size + 0.25 * (stage + 1),
            # As runs without stored states have it.
            **({"stored_states": stored * (stage + 1)} if stored else {}),
            **success(np.nan if rates is None else rates[stage + 1, task], seed),
        }
        for stage in range(-1, stages)
        for task in range(len(tasks))
        for seed in members
    ]
    chunks = [(stage, x) for stage in range(stages) for x in (250, 500, 1000)]
    training = [
        {
            "stage": stage,
            "member": seed - first,
            "seed": seed,
            "interactions": x,
            "return": None,
            "reward": None if x == 250 else (x * (stage + 1) + 300 * seed) / 10,
            "critic_loss": 0.5,
            **success(learning[stage, k % 3], seed),
        }
        for k, (stage, x) in enumerate(chunks)
        for seed in members
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


def write_cw(
    folder: Path, *, rates: np.ndarray = RATES, scenario: str = "t3", **options: Any
) -> Path:
    """The same of a run on Meta-World."""
    named = {"tasks": TRIPLET, "backend": "mujoco", "reward": "v2"} | options
    name = f"continual_world/{scenario}"
    return write_run(folder, rates=rates, scenario=name, **named)


def write_alone(folder: Path, task: str, learning: Sequence[float], **options: Any):
    """A run that learns one task, with these rates of its training episodes."""
    return write_cw(
        folder,
        scenario=task,
        method="ft1",
        tasks=(task,),
        stages=1,
        learning=np.array([learning]),
        **options,
    )


def rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV."""
    with path.open() as file:
        return list(csv.DictReader(file))


def cells(page: Path, label: str) -> dict[str, str]:
    """A run's row of the first table of a report's Markdown, by heading."""
    table = page.read_text().split("\n\n| ")[1].splitlines()
    split = [line.strip("| ").split(" | ") for line in table]
    (found,) = [row for row in split if row[0] == label]
    return dict(zip(split[0], found, strict=True))


def replace_line(path: Path, number: int, text: str) -> None:
    lines = path.read_text().split("\n")
    lines[number - 1] = text
    path.write_text("\n".join(lines))
