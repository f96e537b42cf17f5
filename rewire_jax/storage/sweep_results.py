"""Reads the result files of a sweep's folder, finished or not, into arrays."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.errors import UserError
from rewire_jax.storage.json_lines import document, index, number, reading, table
from rewire_jax.storage.run_results import Head, read_head, result, times

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Whole = NDArray[np.int64]


@dataclass(frozen=True)
class SweepData:
    """What a sweep has written so far, of M members, T stages and as many tasks.

    Attributes:
        folder: the sweep's folder.
        settings: the resolved settings that all members share.
        tasks: names of the whole sequence, T of them.
        provenance: command, commit, versions, device and start time.
        episode_length: steps to the time limit.
        random: how many configurations were drawn; 0 for a grid or a list.
        halving: of this many configurations, one goes on to the next task.
        axes: values of the members by name, `[M]` each.
        configurations: number of each member's configuration, `[M]`.
        seeds: `[M]`.
        trained: whether a member is trained in a stage, `[M, T]`; false for stages
            that have not begun.
        evaluated: whether it has been evaluated for all tasks after it, `[M, T]`.
        diverged: whether it was marked as diverged by then, `[M, T]`.
        scores: evaluation returns `[M, T stages, T tasks]`, NaN where missing.
        choice: the same of other episodes, by which settings are chosen.
        model_size: numbers stored ÷ those of one policy, `[M, T]`, NaN where missing.
        training: interactions spent on training since the beginning, in the same form.
        selection: the same of choosing and rolling back.
        hours: wall clock of training all members, with compilation, without selection
            and evaluation.
    """

    folder: Path
    settings: dict[str, Any]
    tasks: tuple[str, ...]
    provenance: dict[str, Any]
    episode_length: int
    random: int
    halving: int
    axes: dict[str, Array]
    configurations: Whole
    seeds: Whole
    trained: Flags
    evaluated: Flags
    diverged: Flags
    scores: Array
    choice: Array
    model_size: Array
    training: Array
    selection: Array
    hours: float

    @property
    def finished(self) -> int:
        """Number of leading stages that are evaluated for all members in them."""
        done = self.trained.any(axis=0) & (self.evaluated | ~self.trained).all(axis=0)
        return int(np.cumprod(done).sum())

    @property
    def complete(self) -> bool:
        """Whether every task has been trained and evaluated."""
        return self.finished == len(self.tasks)

    @property
    def reached(self) -> Whole:
        """`[M]`: number of leading stages after which a member has been evaluated."""
        return np.cumprod(self.evaluated, axis=1).sum(axis=1)

    @property
    def stopped(self) -> Flags:
        """`[M, T]`: whether a member was halved away after a stage."""
        later = np.roll(self.trained, -1, axis=1)
        later[:, -1] = False
        return self.trained & ~later & later.any(axis=0)


def read_sweep(folder: str | Path) -> SweepData:
    """Reads a sweep from its folder alone.

    As in a run's tables, a last line that was cut is ignored, and a row written again
    replaces the earlier one.

    Args:
        folder: holds `settings.json`, and for each stage that has begun a folder
            `task-…` with `batches.json` and a folder for each batch.

    Raises:
        UserError: a file is missing, or damaged elsewhere than in its last line.
    """
    folder = Path(folder)
    path = folder / "settings.json"
    head = read_head(path)
    drawn, halving, axes, configurations, seeds = _design(path, head)
    count, tasks = len(seeds), len(head.tasks)
    trained = np.zeros((count, tasks), bool)
    seen, diverged = (np.zeros((count, tasks, tasks), bool) for _ in range(2))
    scores, choice = (np.full((count, tasks, tasks), np.nan) for _ in range(2))
    facts = np.full((3, count, tasks), np.nan)
    hours = 0.0

    def parse(row: dict[str, Any]) -> tuple[tuple[int, ...], dict[str, Any]]:
        (stage, task, _), values = result(row, tasks)
        key = index(row, "member", 0, count), stage, task
        return key, values | {"choice": number(row["choice"])}

    for now, place, members in _batches(folder, count, tasks):
        trained[members, now] = True
        hours += times(place / "timing.jsonl", tasks, len(members), False)[0]
        rows = table(place / "results.jsonl", parse, needed=False)
        for (member, stage, task), row in rows.items():
            if stage < 0:  # before any training
                continue
            at = member, stage, task
            seen[at], diverged[at] = True, row["diverged"]
            scores[at], choice[at] = row["return"], row["choice"]
            facts[:, member, stage] = row["model_size"], *row["interactions"]
    evaluated: Flags = np.all(seen, axis=2)
    if not evaluated.any():
        raise UserError(f"{folder} holds no results after training yet")
    return SweepData(
        folder=folder,
        settings=head.settings,
        tasks=head.tasks,
        provenance=head.provenance,
        episode_length=head.episode_length,
        random=drawn,
        halving=halving,
        axes=axes,
        configurations=configurations,
        seeds=seeds,
        trained=trained,
        evaluated=evaluated,
        diverged=np.logical_or.accumulate(diverged.any(axis=2), axis=1),
        scores=scores,
        choice=choice,
        model_size=facts[0],
        training=facts[1],
        selection=facts[2],
        hours=hours,
    )


def _design(path: Path, head: Head) -> tuple[int, int, dict[str, Array], Whole, Whole]:
    """What a header says of the members, see `SweepData`."""
    if head.whole.get("kind") != "sweep":
        raise UserError(f"{path.parent} is not the folder of a sweep: it holds a run")
    with reading(path):
        members = list(head.whole["members"])
        axes = {
            name: np.array([member["values"][name] for member in members], np.float64)
            for name in members[0]["values"]
        }
        configurations, seeds = (
            np.array([member[name] for member in members], np.int64)
            for name in ("configuration", "seed")
        )
        if [member["member"] for member in members] != list(range(len(members))):
            raise ValueError("members are not in order")
        drawn, halving = int(head.whole["random"]), int(head.whole["halving"])
    return drawn, halving, axes, configurations, seeds


def batches_of(folder: Path, stage: int) -> Path:
    """The file that says which members are trained on a task side by side."""
    return folder / f"task-{stage:03d}" / "batches.json"


def batch(folder: Path, stage: int, number: int) -> Path:
    """The folder of a batch."""
    return batches_of(folder, stage).with_name(f"batch-{number:03d}")


def read_batches(path: Path) -> tuple[list[list[int]], int]:
    """The members of each batch, and its number of slots; from `batches_of`.

    Raises:
      UserError: the file is missing or damaged.
    """
    read = document(path)
    with reading(path):
        return [[int(m) for m in b] for b in read["batches"]], int(read["size"])


def _batches(
    folder: Path, count: int, tasks: int
) -> Iterator[tuple[int, Path, list[int]]]:
    """Stage, folder and members of each batch of the stages that have begun."""
    for stage in range(tasks):
        path = batches_of(folder, stage)
        if not path.exists():
            return
        batches, _ = read_batches(path)
        with reading(path):
            if not all(0 <= member < count for batch in batches for member in batch):
                raise ValueError(f"members are 0 to {count - 1}")
        for place, members in enumerate(batches):
            yield stage, batch(folder, stage, place), members
