"""What the result files of a run and of a sweep share, and how they are read."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.errors import UserError
from rewire_jax.storage import checkpoint, fields, run_folder
from rewire_jax.storage.json_lines import number, reading, table
from rewire_jax.storage.scores import SUCCESS

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = dict[tuple[int, ...], dict[str, float]]
"""Values of evaluations by member, stage and task; -1 is the stage before training."""

_FACTS = {
    "diverged": "diverged",
    "model_size": "model_size",
    "training": "interactions.training",
    "selection": "interactions.selection",
}
"""What is the same in all rows of an evaluation of a member: names of the fields."""


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
        if not isinstance(header["tasks"], list) or not header["tasks"]:
            raise ValueError("tasks are no list of names")
        dict(header["provenance"].get("versions", {}))  # as pages show them
        fields.checked(header["settings"], fields.SETTINGS)
        fields.checked(header, fields.HEADER)
        known_changes(header)
        results = Results(
            folder=folder,
            settings=dict(header["settings"]),
            tasks=tuple(str(name) for name in header["tasks"]),
            provenance=dict(header["provenance"]),
            episode_length=int(header["episode_length"]),
            header=header,
        )
    return results


def known_changes(header: Mapping[str, Any]) -> dict[str, Any]:
    """How tasks differ from their domain, by their names, as far as a header says it.

    Headers of older versions do not; and a scenario may be made without `TaskChange`.
    """
    changes = header.get("changes") or [None] * len(header["tasks"])
    pairs = zip(header["tasks"], changes, strict=True)
    return {name: change for name, change in pairs if change is not None}


def check_tables(folder: Path) -> None:
    """Raises `UserError` if rows have changed since a run's newest checkpoint."""
    newest = checkpoint.newest_metadata(folder / "checkpoints")
    changed = run_folder.changed(folder, newest.get("tables", {}))
    if changed:
        raise UserError(
            f"{changed} has lost or changed rows since it was written: restore it, "
            "or run the command again with --resume"
        )


def check_member(row: Mapping[str, Any], seeds: Mapping[int, int]) -> int:
    """The member of a row, by the seed of each; `ValueError` if there is none."""
    member, seed = row["member"], row["seed"]
    if seeds.get(member) != seed:
        raise ValueError(f"there is no member {member} with seed {seed}")
    return member


def read_evaluations(
    path: Path,
    names: Sequence[str],
    seeds: Mapping[int, int],
    stages: range,
    *,
    also: tuple[str, ...] = (),
    needed: bool = True,
) -> Rows:
    """The rows of a `results.jsonl`.

    Args:
        path: the file.
        names: of the sequence's tasks.
        seeds: of the members, by number.
        stages: that it may hold.
        also: values that rows must have besides a run's.
        needed: otherwise a missing file has no rows.

    Raises:
        UserError: the file is missing, or damaged elsewhere than in its last line.
    """
    known = fields.results(len(names), stages)

    def parse(row: dict[str, Any]) -> tuple[tuple[int, ...], dict[str, float]]:
        row = fields.checked(row, known)
        if row["name"] != names[row["task"]]:
            raise ValueError(f"name is {row['name']}, not that of task {row['task']}")
        rates = [each.name for each in SUCCESS.values() if each.name in row]
        values = {name: number(row[name]) for name in ("return", *rates, *also)}
        values |= {name: float(row[field]) for name, field in _FACTS.items()}
        values["stored_states"] = float(row.get("stored_states", 0))
        return (check_member(row, seeds), row["stage"], row["task"]), values

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


def read_timing(path: Path, stages: range, members: int, needed: bool) -> Timing:
    """What a `timing.jsonl` says.

    Args:
        path: the file.
        stages: that it may hold.
        members: trained together.
        needed: otherwise a missing file has no rows.

    Raises:
        UserError: the file is missing, or damaged elsewhere than in its last line.
    """
    known = fields.timing(stages)

    def parse(row: dict[str, Any]) -> tuple[tuple[int, ...], tuple[Any, ...]]:
        row = fields.checked(row, known)
        # Updates after a task's last interaction have reports of their own.
        key = row["stage"], row["interactions"], row.get("polishing", 0)
        where = "device" if "memory.device" in row else "process"
        most = row.get(f"memory.{where}", 0)
        return key, (row["seconds"], row["compile"], where, most)

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
