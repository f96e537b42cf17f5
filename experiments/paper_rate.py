"""Runs the paper profile briefly on each domain, and estimates the time of whole runs.

Interactions per second are measured after the first updates and after all compilation.
The estimated hours do not include evaluation and selection.
"""

import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import rewire_jax
from experiments import suite

COLUMNS = {
    "scenario": suite.show("scenario"),
    "interactions/s": suite.show("interactions_per_second", ".0f"),
    "whole scenario": suite.show("paper_interactions", ","),
    "hours of training": suite.show("hours", ".1f"),
}
SCENARIOS = ("halfcheetah/forgetting", "ant/forgetting", "humanoid/hard")


@dataclass(frozen=True, kw_only=True)
class PaperRate:
    """What to measure.

    Attributes:
      method: name of the method.
      interactions: interactions to train on the first task of each scenario.
      out: the result files, without a suffix.
    """

    method: str = "rewire"
    interactions: int = 20_480
    out: Path = suite.RESULTS / "paper-rate"


def measure(name: str, job: PaperRate, folder: Path) -> dict[str, Any]:
    """Runs the beginning of one scenario."""
    scenario = rewire_jax.make_scenario(name)
    paper = rewire_jax.preset(scenario, job.method, "paper")
    settings = replace(
        paper,
        tasks=1,
        interactions=job.interactions,
        eval_episodes=2,
        selection_episodes=1,
        report_every=1_280,
        checkpoint_every=0,
    )
    rewire_jax.train(settings, folder, scenario=scenario)
    lines = (folder / "timing.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    learning = [row for row in rows if row["interactions"] > paper.warmup + 1_280]
    seconds = sum(row["seconds"] for row in learning)
    rate = 1_280 * len(learning) / seconds
    total = paper.tasks * paper.interactions
    return {
        "scenario": name,
        "method": job.method,
        "backend": scenario.backend,
        "interactions": settings.interactions,
        "interactions_per_second": rate,
        "paper_interactions": total,
        "hours": total / rate / 3600,
    }


def run(job: PaperRate) -> None:
    """Measures all three domains and writes the result."""
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            measure(name, job, Path(folder) / str(number))
            for number, name in enumerate(SCENARIOS)
        ]
    title = (
        f"{job.method}, paper profile, 1 seed, {rows[0]['backend']} backend, first "
        f"{job.interactions:,} interactions"
    )
    suite.write(job.out, title, suite.table(rows, COLUMNS), (), rows)


if __name__ == "__main__":
    suite.command(PaperRate, run, "paper_rate")
