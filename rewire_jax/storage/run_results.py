"""Reads the result files of a run folder, finished or not, into arrays."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.errors import UserError
from rewire_jax.storage import run_folder
from rewire_jax.storage.json_lines import document, index, number, reading, table
from rewire_jax.storage.scores import RETURN, SCORES, SUCCESS, Score, Success

Array = NDArray[np.float64]
_NEEDED = {
    "scenario": str,
    "method": str,
    "profile": str,
    "backend": str,
    "interactions": int,
}


class Head(NamedTuple):
    """What a header says: the first four as in `RunData`, and the whole of it."""

    settings: dict[str, Any]
    tasks: tuple[str, ...]
    provenance: dict[str, Any]
    episode_length: int
    whole: dict[str, Any]


@dataclass(frozen=True)
class RunData:
    """What a run has written so far.

    Attributes:
        folder: the run folder.
        settings: the resolved settings saved with the run.
        tasks: names of the whole sequence, T of them.
        provenance: command, commit, versions, device and start time.
        seeds: the S seeds that have results.
        diverged: those among them that were marked as diverged.
        score: what the run is measured by.
        measured: evaluations by each score there is, `[S, 1 + T stages, T tasks]`, NaN
            where missing; the first of the stages is before any training.
        finished: number of leading stages that are evaluated for all tasks and seeds.
        model_size: numbers stored ÷ those of one policy, the maximum over the run.
        training: interactions spent on training, a seed.
        selection: interactions spent on choosing and rolling back, a seed.
        episode_length: steps to the time limit.
        curve: per stage, interactions within the task `[points]` and the score of
            training, `[S, points]`, NaN where missing; the return is what the reward
            a step makes in a whole episode.
        hours: wall clock of training in all seeds together, with compilation, without
            selection and evaluation.
        rate: training interactions of all seeds per second, without the chunks that
            compiled and without updates that follow a task's last interaction; None
            where there is no other chunk.
        memory: most bytes held in training, by `device` or, without memory of its own,
            `process`; empty where this was not recorded.
    """

    folder: Path
    settings: dict[str, Any]
    tasks: tuple[str, ...]
    provenance: dict[str, Any]
    seeds: tuple[int, ...]
    diverged: tuple[int, ...]
    score: Score
    measured: dict[Score, Array]
    finished: int
    model_size: float
    training: int
    selection: int
    episode_length: int
    curve: tuple[tuple[Array, Array], ...]
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
    def kept(self) -> NDArray[np.bool_]:
        """`[S]`: the seeds that count, which are those that did not diverge."""
        return np.array([seed not in self.diverged for seed in self.seeds], bool)


def read_run(folder: str | Path, success: Success = "any") -> RunData:
    """Reads a run from its folder alone.

    The last line of a table may have been cut by a crash and is then ignored. A row
    written again by a resumed run replaces the earlier one.

    Args:
        folder: holds `settings.json`, `results.jsonl` and, once training has begun,
            `training.jsonl` and `timing.jsonl`.
        success: which steps count where success is known, which is the score then;
            elsewhere that is the return.

    Raises:
        UserError: a file is missing, or damaged elsewhere than in its last line.
    """
    folder = Path(folder)
    head = read_head(folder / "settings.json")
    tasks = head.tasks
    results = table(folder / "results.jsonl", lambda row: result(row, len(tasks)))
    if not results:
        raise UserError(f"{folder / 'results.jsonl'} holds no results yet")
    seeds = sorted({seed for _, _, seed in results})
    place = {seed: i for i, seed in enumerate(seeds)}
    known = {name for row in results.values() for name in row}
    shape = len(seeds), len(tasks) + 1, len(tasks)
    measured = {s: np.full(shape, np.nan) for s in SCORES if s.name in known}
    score = SUCCESS[success] if SUCCESS[success] in measured else RETURN
    seen = np.zeros(shape, bool)
    for (stage, task, seed), row in results.items():
        at = place[seed], stage + 1, task
        seen[at] = True
        for each, values in measured.items():
            values[at] = row.get(each.name, np.nan)
    whole = seen.all(axis=(0, 2))
    finished = int(np.cumprod(whole)[1:].sum())
    spent = [row["interactions"] for row in results.values()]
    began = finished > 0
    trained = _curve(folder, len(tasks), place, began, score.training)
    steps = head.episode_length if score.stepwise else 1
    timing = folder / "timing.jsonl"
    hours, rate = times(timing, len(tasks), len(seeds), began)
    return RunData(
        folder=folder,
        settings=head.settings,
        tasks=tasks,
        provenance=head.provenance,
        seeds=tuple(seeds),
        diverged=tuple(sorted({k[2] for k, row in results.items() if row["diverged"]})),
        score=score,
        measured=measured,
        finished=finished,
        model_size=max(row["model_size"] for row in results.values()),
        # Equal for all seeds but those that stopped early because they diverged.
        training=max(training for training, _ in spent),
        selection=max(selection for _, selection in spent),
        episode_length=head.episode_length,
        curve=tuple((x, values * steps) for x, values in trained),
        hours=hours,
        rate=rate,
        memory=_most_held(timing, began),
    )


def read_progress(run: RunData, name: str) -> tuple[tuple[Array, Array], ...]:
    """A value of a run's progress reports, in the shape of `RunData.curve`.

    Args:
        run: as read.
        name: of the value.

    Raises:
        UserError: the run does not report it, or its file is damaged.
    """
    place = {seed: i for i, seed in enumerate(run.seeds)}
    return _curve(run.folder, len(run.tasks), place, run.finished > 0, name)


def read_head(path: Path) -> Head:
    """The header of a run or a sweep; `UserError` if it is missing or damaged."""
    whole = document(path)
    run_folder.check_format(path.parent, whole)
    with run_folder.telling_version(path.parent, whole), reading(path):
        if not isinstance(whole["tasks"], list):
            raise ValueError("tasks are no list")
        head = Head(
            settings=dict(whole["settings"]),
            tasks=tuple(str(name) for name in whole["tasks"]),
            provenance=dict(whole["provenance"]),
            episode_length=int(whole["episode_length"]),
            whole=whole,
        )
    of = head.settings.get
    missing = [name for name, kind in _NEEDED.items() if not isinstance(of(name), kind)]
    if missing or not head.tasks:
        raise UserError(f"{path} lacks {', '.join(missing) or 'tasks'}")
    return head


def result(row: dict[str, Any], tasks: int) -> tuple[tuple[int, ...], dict[str, Any]]:
    """Key (stage, task, seed) and checked values of a row of `results.jsonl`."""
    stage, task = index(row, "stage", -1, tasks), index(row, "task", 0, tasks)
    spent = row["interactions"]
    rates = {each.name: row[each.name] for each in SUCCESS.values() if each.name in row}
    return (stage, task, int(row["seed"])), {
        "return": number(row["return"]),
        **{name: number(rate) for name, rate in rates.items()},
        "diverged": bool(row["diverged"]),
        "model_size": float(row["model_size"]),
        "interactions": (int(spent["training"]), int(spent["selection"])),
    }


def _curve(
    folder: Path, tasks: int, place: dict[int, int], began: bool, name: str
) -> tuple[tuple[Array, Array], ...]:
    """A value of the progress reports per stage, see `RunData.curve`."""

    def parse(row: dict[str, Any]) -> tuple[tuple[int, ...], float]:
        at = index(row, "stage", 0, tasks), int(row["interactions"])
        return (*at, place[row["seed"]]), number(row[name])

    rows = table(folder / "training.jsonl", parse, needed=began)
    curve = []
    for stage in range(tasks):
        points = sorted({key[1] for key in rows if key[0] == stage})
        column = {x: i for i, x in enumerate(points)}
        values = np.full((len(place), len(points)), np.nan)
        for (at, x, seed), value in rows.items():
            if at == stage:
                values[seed, column[x]] = value
        curve.append((np.array(points, np.float64), values))
    return tuple(curve)


def times(
    path: Path, tasks: int, seeds: int, began: bool
) -> tuple[float, float | None]:
    """Hours and rate, see `RunData`, from a `timing.jsonl`."""

    def parse(row: dict[str, Any]) -> tuple[tuple[int, ...], tuple[float, bool]]:
        at = index(row, "stage", 0, tasks), int(row["interactions"])
        # Updates after a task's last interaction have reports of their own.
        key = (*at, int(row.get("polishing", 0)))
        return key, (float(row["seconds"]), bool(row["compile"]))

    interactions, seconds, last = 0, 0.0, (0, 0)
    rows = table(path, parse, needed=began)
    for (stage, x, polishing), (took, compiled) in sorted(rows.items()):
        if not compiled and not polishing:
            # Rows count from the task's start: a chunk is what came on top.
            interactions += x - (last[1] if last[0] == stage else 0)
            seconds += took
        last = (stage, x)
    hours = sum(took for took, _ in rows.values()) / 3600
    return hours, seeds * interactions / seconds if seconds > 0 else None


def _most_held(path: Path, began: bool) -> dict[str, int]:
    """See `RunData.memory`; from a `timing.jsonl`."""

    def parse(row: dict[str, Any]) -> tuple[tuple[int, ...], tuple[str, int]]:
        held = {"process": 0} | row.get("memory", {})
        where = "device" if "device" in held else "process"
        key = int(row["stage"]), int(row["interactions"]), int(row.get("polishing", 0))
        return key, (where, int(held[where]))

    # A run that was stopped goes on in another process, which begins to count anew.
    rows = table(path, parse, needed=began).values()
    where, most = max(rows, key=lambda held: held[1], default=("", 0))
    return {where: most} if most else {}
