"""What the result files of a run and of a sweep share, and how they are read."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.errors import UserError
from rewire_jax.storage import checkpoint, run_folder
from rewire_jax.storage.json_lines import index, number, reading, table
from rewire_jax.storage.scores import SUCCESS

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = dict[tuple[int, ...], dict[str, float]]
"""Values of evaluations by member, stage and task; -1 is the stage before training."""

_SETTINGS = {
    "scenario": str,
    "method": str,
    "profile": str,
    "backend": str,
    "interactions": int,
}
_FACTS = ("diverged", "model_size", "training", "selection")


@dataclass(frozen=True)
class Results:
    """What the header of a run or a sweep says.

    Attributes:
        folder: folder of the run or sweep.
        settings: the resolved settings saved with it.
        tasks: names of the whole sequence, T of them.
        provenance: command, commit, versions, device and start time.
        episode_length: steps to the time limit.
        header: all of it.
    """

    folder: Path
    settings: dict[str, Any]
    tasks: tuple[str, ...]
    provenance: dict[str, Any]
    episode_length: int
    header: dict[str, Any]


class Timing(NamedTuple):
    """What a `timing.jsonl` says.

    Attributes:
        hours: wall clock of training, with compilation, without selection and
            evaluation.
        rate: interactions of all members per second, without the chunks that compiled
            and without updates that follow a task's last interaction; None where there
            is no other chunk.
        memory: most bytes held, by `device` or, without memory of its own, `process`;
            empty where this was not recorded.
    """

    hours: float
    rate: float | None
    memory: dict[str, int]


def read_header(folder: Path, kind: str) -> Results:
    """The header of a run or a sweep.

    Raises:
        UserError: it is missing, damaged or of the other kind.
    """
    header = run_folder.read_header(folder, kind)
    path = folder / run_folder.HEADER
    with run_folder.telling_version(folder, header), reading(path):
        if not isinstance(header["tasks"], list):
            raise ValueError("tasks are no list")
        dict(header["provenance"].get("versions", {}))  # as pages show them
        results = Results(
            folder=folder,
            settings=dict(header["settings"]),
            tasks=tuple(str(name) for name in header["tasks"]),
            provenance=dict(header["provenance"]),
            episode_length=int(header["episode_length"]),
            header=header,
        )
    of = results.settings.get
    lacks = [name for name, kind in _SETTINGS.items() if not isinstance(of(name), kind)]
    if lacks or not results.tasks:
        raise UserError(f"{path} lacks {', '.join(lacks) or 'tasks'}")
    return results


def check_tables(folder: Path) -> None:
    """Raises `UserError` if rows have changed since a run's newest checkpoint."""
    for path in checkpoint.available(folder / "checkpoints"):
        try:
            marks = checkpoint.read_metadata(path).get("tables", {})
        except UserError:  # damaged, or just replaced by a run that goes on
            continue
        changed = run_folder.changed(folder, marks)
        if changed:
            raise UserError(
                f"{changed} has lost or changed rows since it was written: restore it, "
                "or run the command again with --resume"
            )
        return


def read_evaluations(
    path: Path,
    tasks: int,
    member: Callable[[dict[str, Any]], int],
    *,
    also: tuple[str, ...] = (),
    needed: bool = True,
) -> Rows:
    """The rows of a `results.jsonl`.

    Args:
        path: the file.
        tasks: of the sequence.
        member: whose row it is.
        also: values that rows must have besides a run's.
        needed: otherwise a missing file has no rows.

    Raises:
        UserError: the file is missing, or damaged elsewhere than in its last line.
    """

    def parse(row: dict[str, Any]) -> tuple[tuple[int, ...], dict[str, float]]:
        stage, task = index(row, "stage", -1, tasks), index(row, "task", 0, tasks)
        rates = [each.name for each in SUCCESS.values() if each.name in row]
        spent = row["interactions"]
        values = {name: number(row[name]) for name in ("return", *rates, *also)}
        facts = bool(row["diverged"]), float(row["model_size"])
        counts = int(spent["training"]), int(spent["selection"])
        values |= dict(zip(_FACTS, map(float, (*facts, *counts)), strict=True))
        return (member(row), stage, task), values

    return table(path, parse, needed=needed)


def to_arrays(rows: Rows, members: Iterable[int], tasks: int) -> dict[str, Array]:
    """Values by name, `[M, 1 + T stages, T tasks]` each, NaN where missing."""
    place = {member: i for i, member in enumerate(members)}
    names = {*_FACTS, "return"}.union(*rows.values())
    shape = len(place), 1 + tasks, tasks
    arrays = {name: np.full(shape, np.nan) for name in names}
    for (member, stage, task), row in rows.items():
        for name, value in row.items():
            arrays[name][place[member], stage + 1, task] = value
    return arrays


def read_timing(path: Path, tasks: int, members: int, needed: bool) -> Timing:
    """What a `timing.jsonl` says.

    Args:
        path: the file.
        tasks: of the sequence.
        members: trained together.
        needed: otherwise a missing file has no rows.

    Raises:
        UserError: the file is missing, or damaged elsewhere than in its last line.
    """

    def parse(row: dict[str, Any]) -> tuple[tuple[int, ...], tuple[Any, ...]]:
        # Updates after a task's last interaction have reports of their own.
        updates = int(row.get("polishing", 0))
        held: Mapping[str, Any] = {"process": 0} | row.get("memory", {})
        where = "device" if "device" in held else "process"
        key = index(row, "stage", 0, tasks), int(row["interactions"]), updates
        took = float(row["seconds"]), bool(row["compile"])
        return key, (*took, where, int(held[where]))

    interactions, seconds, last = 0, 0.0, (0, 0)
    rows = table(path, parse, needed=needed)
    for (stage, x, updates), (took, compiled, *_) in sorted(rows.items()):
        if not compiled and not updates:
            # Rows count from the task's start: a chunk is what came on top.
            interactions += x - (last[1] if last[0] == stage else 0)
            seconds += took
        last = (stage, x)
    # A resumed run continues in another process, which counts from 0 again.
    held = ((where, most) for _, _, where, most in rows.values())
    where, most = max(held, key=lambda each: each[1], default=("", 0))
    return Timing(
        hours=sum(took for took, *_ in rows.values()) / 3600,
        rate=members * interactions / seconds if seconds > 0 else None,
        memory={where: most} if most else {},
    )
