"""From the start of a process to its first updates, without and with compilations."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from experiments.speed.part import Effort, Part, Row, show
from rewire_jax.config import require

SETTINGS = {
    "profile": "quick",
    "tasks": 1,
    "warmup": 256,
    "interactions": 512,
    "report-every": 512,
    "eval-episodes": 1,
    "selection-episodes": 1,
    "checkpoint-every": 0,
}


def first_report(scenario: str, folder: Path, cache: Path) -> float:
    """Seconds from the start of `rewire-jax train` to its first progress report.

    The process is ended then.

    Args:
      scenario: what is learned.
      folder: of the run, new.
      cache: folder of compilations.

    Raises:
      UserError: it failed.
    """
    began = time.perf_counter()
    flags = [f"--{name}={value}" for name, value in SETTINGS.items()]
    train = [sys.executable, "-m", "rewire_jax.cli", "train", scenario]
    process = subprocess.Popen(
        [*train, *flags, "--out", str(folder)],
        env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)},
        stdout=subprocess.DEVNULL,
    )
    report = folder / "training.jsonl"
    try:
        while not (report.exists() and report.stat().st_size):
            code = process.poll()
            require(code is None, f"rewire-jax train {scenario} ended with {code}")
            time.sleep(0.01)
        return time.perf_counter() - began
    finally:
        process.kill()
        process.wait()


def measure(effort: Effort) -> list[Row]:
    """A row without earlier compilations, and one with them."""
    seconds: dict[str, list[float]] = {"empty": [], "filled": []}
    for _ in range(1 if effort.quick else 2):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for cache, taken in seconds.items():
                run = folder / cache
                taken.append(first_report(effort.scenario, run, folder / "cache"))
    return [
        {"scenario": effort.scenario, "cache": cache, "least": min(taken)}
        | {"seconds": taken, "share": min(taken) / min(seconds["empty"])}
        for cache, taken in seconds.items()
    ]


PART = Part(
    title="From the start to the first updates",
    reading="`rewire-jax train` with rewire and the quick profile, in a process of its "
    "own, from its start to the first progress report after updates: with an empty "
    "folder of compilations, and with the one that this left. An evaluation and a "
    "selection of one episode each come before.",
    measure=measure,
    columns={
        "scenario": lambda row: row["scenario"],
        "compilation cache": lambda row: row["cache"],
        "seconds, least": show("least", ".1f"),
        "share": show("share", ".0%"),
    },
)
