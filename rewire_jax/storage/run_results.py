"""Reads the result files of a run folder, finished or not, into arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rewire_jax.core.errors import UserError
from rewire_jax.storage import fields
from rewire_jax.storage.json_lines import number, table
from rewire_jax.storage.result_files import (
    Array,
    Flags,
    Results,
    Rows,
    check_member,
    check_tables,
    read_evaluations,
    read_header,
    read_timing,
    to_arrays,
)
from rewire_jax.storage.scores import RETURN, SCORES, SUCCESS, Score, Success


@dataclass(frozen=True)
class RunData(Results):
    """What a run has written so far, and the attributes of `Results`.

    Attributes:
        seeds: the S seeds that have results.
        diverged: those among them that were marked as diverged.
        score: what the run is measured by.
        measured: evaluations by each score there is, `[S, 1 + T stages, T tasks]`, NaN
            where missing; the first of the stages is before any training.
        finished: number of leading stages that are evaluated for all tasks and seeds.
        model_size: numbers stored ÷ those of one policy, the maximum over the run.
        stored_states: the same for numbers of stored states, 0 for most methods.
        training: interactions spent on training, a seed.
        selection: interactions spent on choosing and rolling back, a seed.
        curve: per stage, interactions within the task `[points]` and the score of
            training, `[S, points]`, NaN where missing; the return is what the reward
            a step makes in a whole episode.
        segments: with `--boundaries detected`, the number of the segment in the shape
            of `curve`; else empty.
        hours, rate, memory: of all seeds together, see `Timing`.
    """

    seeds: tuple[int, ...]
    diverged: tuple[int, ...]
    score: Score
    measured: dict[Score, Array]
    finished: int
    model_size: float
    stored_states: float
    training: int
    selection: int
    curve: tuple[tuple[Array, Array], ...]
    segments: tuple[tuple[Array, Array], ...]
    hours: float
    rate: float | None
    memory: dict[str, int]

    @property
    def before(self) -> Array:
        """Scores before any training, `[S, T]`, NaN where missing."""
        return self.measured[self.score][:, 0]

    @property
    def scores(self) -> Array:
        """Scores after each task's training, `[S, T stages, T tasks]`, in that way."""
        return self.measured[self.score][:, 1:]

    @property
    def complete(self) -> bool:
        """Whether every task has been trained and evaluated."""
        return self.finished == len(self.tasks)

    @property
    def kept(self) -> Flags:
        """`[S]`: the seeds that count, which are those that did not diverge."""
        return np.array([seed not in self.diverged for seed in self.seeds], bool)


def read_run(folder: str | Path, success: Success = "any") -> RunData:
    """Reads a run, only from its folder.

    The last line of a table may have been cut by a crash and is then ignored.

    Args:
        folder: holds `settings.json`, `results.jsonl` and, once training has begun,
            `training.jsonl` and `timing.jsonl`.
        success: which steps count where success is known, which is the score then;
            elsewhere that is the return.

    Raises:
        UserError: a file is missing, or damaged elsewhere than in its last line.
    """
    head, rows = read_rows(folder)
    folder, tasks, members = head.folder, len(head.tasks), _members(head)
    found = sorted({member for member, _, _ in rows})
    seeds = [members[member] for member in found]
    values = to_arrays(rows, found, tasks)
    measured = {s: values[s.name] for s in SCORES if s.name in values}
    score = SUCCESS[success] if SUCCESS[success] in measured else RETURN
    whole = (~np.isnan(values["diverged"])).all(axis=(0, 2))
    finished = int(np.cumprod(whole)[1:].sum())
    diverged = (values["diverged"] == 1).any(axis=(1, 2))
    trained = _curve(head, seeds, finished > 0, score.training)
    steps = head.episode_length if score.stepwise else 1
    detected = head.settings.get("boundaries") == "detected"
    path = folder / "timing.jsonl"
    timing = read_timing(path, range(tasks), len(seeds), finished > 0)
    return RunData(
        **vars(head),
        seeds=tuple(seeds),
        diverged=tuple(np.array(seeds)[diverged].tolist()),
        score=score,
        measured=measured,
        finished=finished,
        model_size=float(np.nanmax(values["model_size"])),
        stored_states=float(np.nanmax(values["stored_states"])),
        # Equal for all seeds but those that stopped early because they diverged.
        training=int(np.nanmax(values["training"])),
        selection=int(np.nanmax(values["selection"])),
        curve=tuple((x, values * steps) for x, values in trained),
        segments=_curve(head, seeds, finished > 0, "segment") if detected else (),
        **timing._asdict(),
    )


def read_rows(folder: str | Path) -> tuple[Results, Rows]:
    """The header and the evaluations of a run, as they are in its folder.

    Raises:
        UserError: as `read_run`.
    """
    head = read_header(Path(folder), "run")
    check_tables(head.folder)
    path, stages = head.folder / "results.jsonl", range(-1, len(head.tasks))
    rows = read_evaluations(path, head.tasks, _members(head), stages)
    if not rows:
        raise UserError(f"{path} holds no results yet")
    return head, rows


def read_progress(run: RunData, name: str) -> tuple[tuple[Array, Array], ...]:
    """A value of a run's progress reports, in the shape of `RunData.curve`.

    Args:
        run: as read.
        name: name of the value.

    Raises:
        UserError: the run does not report it, or its file is damaged.
    """
    return _curve(run, run.seeds, run.finished > 0, name)


def _members(head: Results) -> dict[int, int]:
    """The seed of each member."""
    first, count = (head.settings[name] for name in ("seed", "seeds"))
    return dict(enumerate(range(first, first + count)))


def _curve(
    head: Results, seeds: Sequence[int], began: bool, name: str
) -> tuple[tuple[Array, Array], ...]:
    """A value of the progress reports per stage, see `RunData.curve`."""
    place = {seed: i for i, seed in enumerate(seeds)}
    members, stages = _members(head), range(len(head.tasks))
    known = fields.training(stages)

    def parse(row: dict[str, Any]) -> tuple[tuple[int, ...], float]:
        row = fields.checked(row, known, fields.OTHERS)
        check_member(row, members)
        key = row["stage"], row["interactions"], place[row["seed"]]
        return key, number(row[name])

    rows = table(head.folder / "training.jsonl", parse, needed=began)
    curve = []
    for stage in stages:
        points = sorted({key[1] for key in rows if key[0] == stage})
        column = {x: i for i, x in enumerate(points)}
        values = np.full((len(place), len(points)), np.nan)
        for (at, x, seed), value in rows.items():
            if at == stage:
                values[seed, column[x]] = value
        curve.append((np.array(points, np.float64), values))
    return tuple(curve)
