"""Runs the paper profile briefly on each domain, and says what all of it would take.

Interactions per second are taken once updates are under way and nothing compiles any
more. Evaluation and selection come on top of the hours given.
"""

import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

import rewire_jax
from rewire_jax.storage.run_folder import provenance

SCENARIOS = ("halfcheetah/forgetting", "ant/forgetting", "humanoid/hard")


@dataclass(frozen=True, kw_only=True)
class PaperRate:
    """What to measure.

    Attributes:
      method: name of the method.
      interactions: of the first task of each scenario.
      out: result file; a Markdown table is written beside it.
    """

    method: str = "rewire"
    interactions: int = 20_480
    out: Path = Path("experiments/results/paper-rate.json")


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
    facts = provenance()
    result = {"method": job.method, "rows": rows, "provenance": facts}
    job.out.parent.mkdir(parents=True, exist_ok=True)
    job.out.write_text(json.dumps(result, indent=1) + "\n")
    table = [
        f"# {job.method}, paper profile, 1 seed, {rows[0]['backend']} backend, first "
        f"{job.interactions:,} interactions; {facts['device']}",
        "",
        "| scenario | interactions/s | whole scenario | training would take |",
        "|---|---|---|---|",
    ]
    table += [
        f"| {row['scenario']} | {row['interactions_per_second']:.0f} "
        f"| {row['paper_interactions']:,} | {row['hours']:.1f} h |"
        for row in rows
    ]
    text = "\n".join(table) + "\n"
    job.out.with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    rewire_jax.keep_compiled()
    run(tyro.cli(PaperRate, prog="python -m experiments.paper_rate"))
