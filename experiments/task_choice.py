"""Are tasks recognised by their returns? Evaluates runs with task labels and without.

Runs on the probe are trained first, unless they are finished. `--runs` adds others;
`--methods` without a value leaves out the probe.
"""

import itertools
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rewire_jax
from experiments import suite
from rewire_jax.core.formatting import number
from rewire_jax.reports.provenance import origin
from rewire_jax.storage.run_results import RunData, read_run

PROBE = "probe/reach"
CHOSEN = ("recognised", "return", "interactions")
# Of SAC on the probe: small networks that learn it in seconds.
SMALL: dict[str, Any] = {
    "hidden": 32,
    "depth": 2,
    "batch_size": 64,
    "lr_policy": 1e-3,
    "lr_critic": 3e-3,
    "lr_temperature": 1e-3,
    "discount": 0.9,
    "reward_scale": 1.0,
    "noise_color": 0.0,
    "time_limit": "bootstrap",
    "critic_entropy": "sample",
    "policy_states": "current",
}
COLUMNS: suite.Columns = {
    "scenario": suite.show("scenario"),
    "run": suite.show("run"),
    "trials": suite.show("trials"),
    "steps of a trial": suite.show("trial_steps"),
    "tasks recognised": suite.show("recognised", ".0%"),
    "return": lambda row: number(row["return"]),
    "with labels": lambda row: number(row["labelled"]),
    "interactions for each task": suite.show("interactions", ",.0f"),
    "seeds": suite.show("seeds"),
}
READING = (
    "Successive halving chooses the policy with the best return in trials. Trials: "
    "how often each remaining policy plays in a round. A trial starts with a reset. "
    "Both returns are means over tasks and seeds. "
    "The interactions are those of the trials."
)


@dataclass(frozen=True, kw_only=True)
class TaskChoice(suite.Job):
    """What to evaluate.

    Attributes:
      methods: names of the methods to train on the probe.
      runs: folders of other runs, with finished tasks.
      trials: numbers of trials to compare.
      shares: lengths of a trial to compare, each as a share of an episode.
      episodes: episodes of each task in both evaluations.
      out: folder of the runs on the probe.
      result: the result files, without a suffix.
    """

    seeds: int = 3
    methods: tuple[str, ...] = ("rewire", "sac_n")
    runs: tuple[Path, ...] = ()
    trials: tuple[int, ...] = (1, 4)
    shares: tuple[float, ...] = (0.05, 0.25, 1.0)
    episodes: int = 16
    out: Path = Path("runs/task-choice")
    result: Path = suite.RESULTS / "task-choice" / "probe"

    def probes(self) -> list[suite.Run]:
        """Runs on the probe."""
        scenario = self.scenario_of(PROBE)
        return [
            self.run(scenario, method, self.out / method, SMALL)
            for method in self.methods
        ]


def label(run: RunData) -> str:
    """What runs that differ only in their seed have in common in their paths."""
    folder = run.folder
    return (folder.parent if folder.name.startswith("seed-") else folder).name


def evaluated(job: TaskChoice, run: RunData) -> list[dict[str, Any]]:
    """A row for each seed and trained task, for each number and length of trials."""
    rows = []
    for share, trials in itertools.product(job.shares, job.trials):
        steps = max(1, round(share * run.episode_length))
        played = rewire_jax.evaluate(
            run.folder,
            episodes=job.episodes,
            task_label="none",
            trials=trials,
            trial_steps=steps,
        )
        place = {"scenario": run.settings["scenario"], "run": label(run)}
        place |= {"trial_steps": steps, "trials": trials}
        rows += [
            place
            | {"seed": row["seed"], "task": row["task"], "labelled": row["return"]}
            | {name: row["chosen"][name] for name in CHOSEN}
            for row in played
            if row["chosen"]["recognised"] is not None
        ]
    return rows


def means(rows: Sequence[Mapping[str, Any]]) -> list[suite.Row]:
    """Means over tasks and seeds, a row for each kind of run and each choice."""
    names = ("scenario", "run", "trial_steps", "trials")
    measures = ("labelled", *CHOSEN)
    return [
        dict(zip(names, key, strict=True))
        | {name: statistics.mean(row[name] for row in group) for name in measures}
        | {"seeds": len({row["seed"] for row in group})}
        for key, group in suite.grouped(rows, *names).items()
    ]


def run(job: TaskChoice) -> None:
    """Trains on the probe, evaluates all runs, and writes the table.

    Raises:
      UserError: a folder holds no run with a finished task, or as `suite.train`.
    """
    trained = suite.train(job.probes(), job) if job.methods else []
    runs = [read_run(path) for path in (*(each.folder for each in trained), *job.runs)]
    rows = [row for each in runs for row in evaluated(job, each)]
    kinds: dict[str, list[RunData]] = {}
    for each in runs:
        kinds.setdefault(label(each), []).append(each)
    origins = [origin(name, *own) for name, own in kinds.items()]
    title = f"Tasks recognised by returns, {job.episodes} episodes of each task"
    shown = suite.table(means(rows), COLUMNS)
    suite.write(job.result, title, shown, ["", READING, "", *origins], rows)


if __name__ == "__main__":
    suite.command(TaskChoice, run, "task_choice")
