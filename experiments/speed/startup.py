"""From the start of a process to its first updates, without and with compilations."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from experiments.speed.part import Effort, Part
from experiments.suite import Row, show
from rewire_jax.core.arguments import require

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
    settings = SETTINGS | {"out": folder, "cache": cache}
    flags = [f"--{name}={value}" for name, value in settings.items()]
    train = [sys.executable, "-m", "rewire_jax.cli.main", "train", scenario]
    process = subprocess.Popen([*train, *flags], stdout=subprocess.DEVNULL)
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
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seconds = {
            state: first_report(effort.scenario, folder / state, folder / "cache")
            for state in ("empty", "filled")
        }
    return [
        {"scenario": effort.scenario, "cache": state, "seconds": taken}
        | {"share": taken / seconds["empty"]}
        for state, taken in seconds.items()
    ]


PART = Part(
    title="From the start to the first updates",
    reading="The time from the start of `rewire-jax train` to the first progress "
    "report after updates, with rewire and the quick profile: first with an empty "
    "compilation cache, then with the cache that the first run filled. It includes "
    "one evaluation episode and one selection episode.",
    measure=measure,
    columns={
        "scenario": show("scenario"),
        "compilation cache": show("cache"),
        "seconds": show("seconds", ".1f"),
        "share": show("share", ".0%"),
    },
)
