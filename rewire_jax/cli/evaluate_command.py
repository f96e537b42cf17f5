"""The command `rewire-jax evaluate`; its docstring is the help text."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from rewire_jax.cli.flags import Flags
from rewire_jax.run.evaluation import TaskLabel, evaluate

Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Evaluate(Flags):
    """Evaluates the trained policies of a run on its tasks, without exploration.

    Attributes:
      run: folder of the run.
      stage: use the policies as they were after this task, counted from 0; by default
        the latest finished task.
      episodes: number of episodes for each task.
      seed: seed of the episodes; it is independent of the seed of the run.
      task_label: "none" also evaluates without task labels: one of the policies of all
        tasks is chosen by its return in trials.
      trials: without task labels, how often each remaining policy plays in a round;
        after each round the worse half leaves.
      trial_steps: without task labels, the steps of a trial, from a reset; by default a
        whole episode.
      json: print rows as JSON instead of a table.
    """

    run: tyro.conf.Positional[Path]
    stage: int | None = None
    episodes: int = 128
    seed: int = 0
    task_label: TaskLabel = "given"
    trials: int = 2
    trial_steps: int | None = None
    json: bool = False

    def __call__(self) -> None:
        """Prints the returns of each seed on each task, as a table or as JSON."""
        rows = evaluate(
            self.run,
            stage=self.stage,
            episodes=self.episodes,
            seed=self.seed,
            task_label=self.task_label,
            trials=self.trials,
            trial_steps=self.trial_steps,
        )
        if self.json:
            print("\n".join(json.dumps(row) for row in rows))
            return
        solved = [name for name in ("success", "success_last") if name in rows[0]]
        heads = "".join(f"{name:>14}" for name in solved)
        if self.task_label == "none":
            heads += (
                f"  {'chosen':<28}{'recognised':>10}{'return':>12}{'trial steps':>13}"
            )
        print(f"{'task':<28}{'seed':>6}{'return':>12}{'std':>10}{'steps':>10}{heads}")
        for row in rows:
            task = f"{row['task']} {row['name']}"
            more = "".join(f"{row[name]:>14.2f}" for name in solved)
            if self.task_label == "none":
                more += _chosen(row["chosen"])
            print(
                f"{task:<28}{row['seed']:>6}{row['return']:>12.1f}{row['std']:>10.1f}"
                f"{row['steps']:>10}{more}"
            )
        if self.task_label == "none":
            print(_summary(rows))
        for seed in sorted({row["seed"] for row in rows if row["diverged"]}):
            print(f"seed {seed} has diverged: its policy is from before that")


def _chosen(chosen: Row) -> str:
    """The columns of a choice without task labels."""
    task = f"{chosen['task']} {chosen['name']}"
    recognised = {True: "yes", False: "no", None: "-"}[chosen["recognised"]]
    return (
        f"  {task:<28}{recognised:>10}{chosen['return']:>12.1f}"
        f"{chosen['interactions']:>13}"
    )


def _summary(rows: Sequence[Row]) -> str:
    """Compares both evaluations in a line."""
    choices = [row["chosen"] for row in rows]
    if all(c["candidates"] == 1 for c in choices):
        return "without task labels: all tasks have the same policy; nothing to choose"
    known = [c["recognised"] for c in choices if c["recognised"] is not None]
    labelled, chosen = (np.mean([row["return"] for row in x]) for x in (rows, choices))
    spent = np.mean([c["interactions"] for c in choices])
    return (
        f"without task labels: {np.mean(known):.0%} of the tasks recognised, mean "
        f"return {chosen:.1f} (with labels {labelled:.1f}), {spent:,.0f} interactions "
        "for each task"
    )
