"""From the results of runs to the numbers that a report shows."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rewire_jax import metrics
from rewire_jax.errors import UserError
from rewire_jax.rundata import RunData

Array = NDArray[np.float64]

# Runs that differ in one of these are not comparable and share no table.
_SHARED = ("scenario", "profile", "backend", "interactions")
# The measures of a task, in a table's order, with their headings.
MEASURES = {
    "before": "before training",
    "after": "right after own training",
    "end": "at the end",
    "forgetting": "forgetting",
}


@dataclass(frozen=True)
class Spread:
    """A value over seeds.

    Attributes:
        values: one a seed, NaN where missing.
        mean: None without values.
        std: the sample standard deviation, None with fewer than two seeds.
    """

    values: tuple[float, ...]
    mean: float | None
    std: float | None


@dataclass(frozen=True)
class Summary:
    """A run's numbers; its diverged seeds are left out.

    Attributes:
        label: the method, with the folder's name where two runs share a method.
        run: what was read.
        tasks: for each task of the sequence, its `MEASURES`; those of tasks not
            trained yet have no values but `before`.
        performance: returns after the last finished stage, averaged over the tasks
            trained by then.
        forgetting: averaged over those tasks.
    """

    label: str
    run: RunData
    tasks: tuple[dict[str, Spread], ...]
    performance: Spread
    forgetting: Spread


def summarize(runs: Sequence[RunData]) -> tuple[Summary, ...]:
    """Summarizes comparable runs.

    Args:
        runs: one or more, complete or partial.

    Raises:
        UserError: there is no run, one is given twice, or they are not comparable.
    """
    if not runs:
        raise UserError("no run to report on")
    first = runs[0]
    for run in runs[1:]:
        for name in _SHARED:
            mine, other = run.settings[name], first.settings[name]
            if mine != other:
                raise UserError(
                    f"cannot compare {run.folder} ({name} {mine}) with "
                    f"{first.folder} ({name} {other})"
                )
        if run.tasks != first.tasks:
            raise UserError(
                f"cannot compare {run.folder} with {first.folder}: other tasks"
            )
    labels = _labels(runs)
    return tuple(_summary(run, label) for run, label in zip(runs, labels, strict=True))


def spread(values: Array) -> Spread:
    """Mean and sample standard deviation over seeds.

    Args:
        values: `[seeds]`; NaN is passed over.
    """
    there = values[~np.isnan(values)]
    return Spread(
        values=tuple(values.tolist()),
        mean=float(there.mean()) if there.size else None,
        std=float(there.std(ddof=1)) if there.size > 1 else None,
    )


def _summary(run: RunData, label: str) -> Summary:
    done, kept = run.finished, run.kept
    # The tasks trained so far are a sequence of their own: the measures hold for it.
    matrix = run.scores[kept][:, :done, :done]
    columns = {"before": run.before[kept]}
    means = {"performance": np.zeros(0), "forgetting": np.zeros(0)}
    if done:
        columns["after"] = metrics.after_own_training(matrix)
        columns["end"] = metrics.final(matrix)
        columns["forgetting"] = metrics.forgetting(matrix)
        means["performance"] = metrics.performance(matrix)
        means["forgetting"] = columns["forgetting"].mean(axis=-1)
    empty = np.zeros(0)
    tasks = tuple(
        {
            name: spread(values[:, task])
            if (values := columns.get(name)) is not None and task < values.shape[1]
            else spread(empty)
            for name in MEASURES
        }
        for task in range(len(run.tasks))
    )
    return Summary(
        label=label,
        run=run,
        tasks=tasks,
        performance=spread(means["performance"]),
        forgetting=spread(means["forgetting"]),
    )


def _labels(runs: Sequence[RunData]) -> list[str]:
    """The shortest of method, folder name, path that tells the runs apart."""
    folders = Counter(run.folder.resolve() for run in runs)
    folder, times = folders.most_common(1)[0]
    if times > 1:
        raise UserError(f"{folder} is given twice")
    methods = [str(run.settings["method"]) for run in runs]
    names = [f"{m} ({r.folder.name})" for m, r in zip(methods, runs, strict=True)]
    paths = [f"{m} ({r.folder})" for m, r in zip(methods, runs, strict=True)]
    labels = []
    for method, name, path in zip(methods, names, paths, strict=True):
        if methods.count(method) == 1:
            labels.append(method)
        else:
            labels.append(name if names.count(name) == 1 else path)
    return labels
