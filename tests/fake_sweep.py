"""Writes folders of sweeps with known numbers, for the tests of what reads them."""

import json
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from tests.fake_run import BUDGET, PROVENANCE, TASKS

GRID = tuple(
    {"modes": k, "alpha": a, "beta": b}
    for k, a, b in product((1, 2, 3), (0.0, 1e-5), (1.0, 100.0))
)


def score(member: dict[str, Any], stage: int, task: int) -> float:
    """Best are three modes, some alpha and a small beta; seeds differ."""
    values = member["values"]
    good = 100 * values["modes"] + 2e6 * values["alpha"] - values["beta"]
    return good + 10 * member["seed"] + 7 * stage - 3 * task


def choice(member: dict[str, Any], stage: int, task: int) -> float:
    """The same of other episodes."""
    return score(member, stage, task) + 1.5


def write_sweep(
    folder: Path,
    *,
    configurations: Sequence[Mapping[str, float]] = GRID,
    seeds: int = 2,
    stages: int = 3,
    size: int = 5,
    going_on: Sequence[Sequence[int]] = (),
    diverged: Mapping[int, int] | None = None,
    score: Callable[[dict[str, Any], int, int], float] = score,
    choice: Callable[[dict[str, Any], int, int], float] = choice,
    head: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Path:
    """A folder of a sweep.

    Args:
        folder: is made.
        configurations: values by axis.
        seeds: of each.
        stages: tasks trained.
        size: members of a batch.
        going_on: for each task after the first, the configurations trained on it;
            without, all.
        diverged: members and the stage in which they diverged.
        score: a member's reported return after a stage on a task.
        choice: the same of the choosing episodes.
        head: other values in the header.
        settings: the same in its settings.
    """
    folder.mkdir(parents=True)
    members = [
        {
            "member": c * seeds + seed,
            "configuration": c,
            "seed": seed,
            "values": dict(values),
        }
        for c, values in enumerate(configurations)
        for seed in range(seeds)
    ]
    axes = {n: sorted({c[n] for c in configurations}) for n in configurations[0]}
    header = {
        "format": 1,
        "kind": "sweep",
        "settings": {
            "scenario": "halfcheetah/forgetting",
            "method": "rewire",
            "profile": "quick",
            "backend": "positional",
            "seed": 0,
            "seeds": seeds,
            "interactions": BUDGET,
            **settings,
        },
        "axes": axes,
        "random": 0,
        "halving": 1,
        "members": members,
        "tasks": TASKS,
        "episode_length": 10,
        "provenance": PROVENANCE,
        **(head or {}),
    }
    (folder / "settings.json").write_text(json.dumps(header))
    for stage in range(stages):
        there = [
            m
            for m in members
            if not stage or not going_on or m["configuration"] in going_on[stage - 1]
        ]
        batches = [there[i : i + size] for i in range(0, len(there), size)]
        place = folder / f"task-{stage:03d}"
        place.mkdir()
        numbers = [[m["member"] for m in batch] for batch in batches]
        (place / "batches.json").write_text(
            json.dumps({"size": size, "batches": numbers})
        )
        for number, batch in enumerate(batches):
            _write_batch(
                place / f"batch-{number:03d}",
                stage,
                batch,
                diverged or {},
                score,
                choice,
            )
    return folder


def _write_batch(folder, stage, batch, diverged, score, choice) -> None:
    folder.mkdir()
    rows = []
    for now in (-1, 0) if stage == 0 else (stage,):
        for member in batch:
            number = member["member"]
            lost = now >= diverged.get(number, 99)
            rows += [
                {
                    "stage": now,
                    "task": task,
                    "name": TASKS[task],
                    "seed": member["seed"],
                    "member": number,
                    "return": None if lost else score(member, now, task),
                    "choice": None if lost else choice(member, now, task),
                    "episodes": 10,
                    "interactions": {
                        "training": BUDGET * (now + 1),
                        "selection": 7 * (now + 1) + number,
                    },
                    "diverged": lost,
                    "model_size": 1.5 + 0.25 * (now + 1) + number / 100,
                }
                for task in range(len(TASKS))
            ]
    timing = [{"stage": stage, "interactions": 500, "seconds": 36, "compile": True}]
    for name, table in (("results", rows), ("timing", timing)):
        lines = "".join(json.dumps(row) + "\n" for row in table)
        (folder / f"{name}.jsonl").write_text(lines)
