"""Reads the result files of a sweep's folder, finished or not, into arrays."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.errors import UserError
from rewire_jax.storage import fields
from rewire_jax.storage.json_lines import document, reading
from rewire_jax.storage.result_files import (
    Array,
    Flags,
    Results,
    Rows,
    check_tables,
    read_evaluations,
    read_header,
    read_timing,
    to_arrays,
)
from rewire_jax.storage.run_folder import HEADER

Whole = NDArray[np.int64]


@dataclass(frozen=True)
class SweepData(Results):
    """What a sweep has written so far, of M members, T stages and as many tasks.

    It also has the attributes of `Results`.

    Attributes:
        random: how many configurations were drawn; 0 for a grid or a list.
        halving: one in this many configurations continues with the next task.
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
        hours: hours of all members together, see `Timing`.
    """

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
    """Reads a sweep, only from its folder.

    As in a run's tables, a last line that was cut is ignored.

    Args:
        folder: holds `settings.json`, and for each stage that has begun a folder
            `task-…` with `batches.json` and a folder for each batch.

    Raises:
        UserError: a file is missing, or damaged elsewhere than in its last line.
    """
    head = read_header(Path(folder), "sweep")
    design = _design(head)
    count, tasks = len(design["seeds"]), len(head.tasks)
    trained, hours = np.zeros((count, tasks), bool), 0.0
    rows: Rows = {}
    for now, place, members in each_batch(head.folder, count, tasks):
        trained[members, now] = True
        check_tables(place)
        stages = range(now, now + 1)
        hours += read_timing(place / "timing.jsonl", stages, len(members), False).hours
        rows |= read_evaluations(
            place / "results.jsonl",
            head.tasks,
            {member: int(design["seeds"][member]) for member in members},
            stages if now else range(-1, 1),  # before any training, too
            also=("choice",),
            needed=False,
        )
    values = to_arrays(rows, range(count), tasks)
    # What was before any training is left out.
    values = {name: array[:, 1:] for name, array in values.items()}
    evaluated: Flags = np.all(~np.isnan(values["diverged"]), axis=2)
    if not evaluated.any():
        raise UserError(f"{folder} holds no results after training yet")
    # Facts of a member are the same for all tasks of an evaluation.
    facts = {
        name: np.fmax.reduce(values[name], axis=2)
        for name in ("diverged", "model_size", "training", "selection")
    }
    return SweepData(
        **vars(head),
        **design,
        trained=trained,
        evaluated=evaluated,
        diverged=np.logical_or.accumulate(facts.pop("diverged") == 1, axis=1),
        scores=values["return"],
        choice=values["choice"],
        **facts,
        hours=hours,
    )


def _design(head: Results) -> dict[str, Any]:
    """What a header says of the members, see `SweepData`."""
    with reading(head.folder / HEADER):
        asked = fields.checked(head.header, fields.SWEEP)
        members = list(head.header["members"])
        if [member["member"] for member in members] != list(range(len(members))):
            raise ValueError("members are not in order")
        return {
            "random": asked["random"],
            "halving": asked["halving"],
            "axes": {
                name: np.array([member["values"][name] for member in members], float)
                for name in members[0]["values"]
            },
            "configurations": np.array([m["configuration"] for m in members], np.int64),
            "seeds": np.array([member["seed"] for member in members], np.int64),
        }


def batches_of(folder: Path, stage: int) -> Path:
    """The file that says which members are trained together on a task."""
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
        batches, size = read["batches"], read["size"]
        members = [member for batch in batches for member in batch]
        if not members or not all(type(number) is int for number in (*members, size)):
            raise ValueError("batches are lists of numbers of members")
        if len(set(members)) < len(members):
            raise ValueError("a member is in two batches")
        if not 1 <= max(map(len, batches)) <= size:
            raise ValueError(f"batches of {size} slots do not fit")
        return batches, size


def each_batch(
    folder: Path, count: int, tasks: int
) -> Iterator[tuple[int, Path, list[int]]]:
    """Stage, folder and members of each batch of the stages that have begun.

    Args:
      folder: folder of the sweep.
      count: number of its members.
      tasks: number of its tasks.

    Raises:
      UserError: a file is damaged, or has other members.
    """
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
