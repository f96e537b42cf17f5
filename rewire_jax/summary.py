"""From the results of runs to the numbers that a report shows."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rewire_jax import metrics, published
from rewire_jax.errors import UserError
from rewire_jax.published import Figures, Source
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
class Interval:
    """A value with its 95% interval, None where there is none."""

    value: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Summary:
    """A run's numbers; its diverged seeds are left out.

    Where a SAC-N run normalises, all but `tasks` are multiples of its performance.

    Attributes:
        label: the method as the paper calls it, with the folder's name where two runs
            share a method.
        run: what was read.
        tasks: for each task of the sequence, the returns of its `MEASURES`; those of
            tasks not trained yet have no values but `before`.
        performance: score after the last finished stage, averaged over the tasks
            trained by then.
        iqm: interquartile mean of these scores over seeds and tasks, with its
            stratified bootstrap interval.
        forgetting: averaged over those tasks.
        transfer: forward transfer averaged over those tasks, where SAC-N normalises.
        published: the paper's result from each source, None where it has none or where
            several runs share the method.
    """

    label: str
    run: RunData
    tasks: tuple[dict[str, Spread], ...]
    performance: Spread
    iqm: Interval
    forgetting: Spread
    transfer: Spread
    published: tuple[Figures | None, ...]


@dataclass(frozen=True)
class Comparison:
    """Comparable runs.

    Attributes:
        summaries: one for each run.
        sources: where `Summary.published` is from.
        raw: why scores are raw returns; None where SAC-N normalises them.
    """

    summaries: tuple[Summary, ...]
    sources: tuple[Source, ...]
    raw: str | None

    @property
    def unit(self) -> str:
        """What scores are measured in."""
        return "raw return" if self.raw else "÷ SAC-N"


def summarize(runs: Sequence[RunData]) -> Comparison:
    """Summarizes comparable runs.

    Args:
        runs: one or more, complete or partial.

    Raises:
        UserError: there is no run, one is given twice, or they are not comparable.
    """
    if not runs:
        raise UserError("no run to report on: name the folder of one or more")
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
    base, raw = _reference(runs)
    sources = published.sources(first.settings["scenario"])
    methods = Counter(run.settings["method"] for run in runs)
    summaries = []
    for run, label in zip(runs, _labels(runs), strict=True):
        method = run.settings["method"]
        # The paper has one result a method: it belongs to none of several variants.
        alone = methods[method] == 1
        theirs = tuple(s.results.get(method) if alone else None for s in sources)
        summaries.append(_summary(run, label, base, theirs))
    return Comparison(tuple(summaries), sources, raw)


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


def _reference(runs: Sequence[RunData]) -> tuple[RunData | None, str | None]:
    """The SAC-N run that normalises all runs, or None and why there is none."""
    found = [run for run in runs if run.settings["method"] == "sac_n"]
    if len(found) != 1:
        some = "more than one SAC-N run" if found else "no SAC-N run"
        return None, f"there is {some} among them to normalise with"
    (base,) = found
    stages = {run.finished for run in runs} - {0}
    if not base.kept.any():
        return None, "all seeds of SAC-N diverged"
    if stages and max(stages) > base.finished:
        return None, "SAC-N has finished fewer tasks than another run"
    averages = [metrics.final(_matrix(base, stage)).mean() for stage in stages]
    if not all(average > 0 for average in averages):
        return None, "SAC-N's average return is not above 0"
    return base, None


def _matrix(run: RunData, done: int) -> Array:
    """`[kept seeds, done, done]`: the first tasks are a sequence of their own."""
    return run.scores[run.kept][:, :done, :done]


def _summary(
    run: RunData,
    label: str,
    base: RunData | None,
    theirs: tuple[Figures | None, ...],
) -> Summary:
    performance = forgetting = transfer = np.zeros(0)
    ends = np.zeros((0, 0))
    if run.finished:
        matrix = _matrix(run, run.finished)
        if base:
            # SAC-N as it was after as many tasks, the mean over its seeds.
            other = _matrix(base, run.finished).mean(axis=0)
            scale = metrics.final(other)
            matrix = metrics.normalise(matrix, scale)
            alone = metrics.normalise(metrics.after_own_training(other), scale)
            transfer = metrics.forward_transfer(matrix, alone).mean(axis=-1)
        performance = metrics.performance(matrix)
        forgetting = metrics.forgetting(matrix).mean(axis=-1)
        ends = metrics.final(matrix)
    return Summary(
        label=label,
        run=run,
        tasks=_tasks(run),
        performance=spread(performance),
        iqm=_iqm(ends),
        forgetting=spread(forgetting),
        transfer=spread(transfer),
        published=theirs,
    )


def _tasks(run: RunData) -> tuple[dict[str, Spread], ...]:
    """Raw returns of each task, see `Summary.tasks`."""
    columns = {"before": run.before[run.kept]}
    if run.finished:
        matrix = _matrix(run, run.finished)
        columns["after"] = metrics.after_own_training(matrix)
        columns["end"] = metrics.final(matrix)
        columns["forgetting"] = metrics.forgetting(matrix)
    empty = np.zeros(0)
    return tuple(
        {
            name: spread(values[:, task])
            if (values := columns.get(name)) is not None and task < values.shape[1]
            else spread(empty)
            for name in MEASURES
        }
        for task in range(len(run.tasks))
    )


def _iqm(scores: Array) -> Interval:
    """Interquartile mean of `[seeds, tasks]`; a seed with NaN is passed over."""
    there = scores[~np.isnan(scores).any(axis=1)]
    if not there.size:
        return Interval(None, None, None)
    value = float(metrics.interquartile_mean(there.ravel()))
    return Interval(value, *(metrics.stratified_bootstrap(there) or (None, None)))


def _labels(runs: Sequence[RunData]) -> list[str]:
    """The shortest of method, folder name, path that tells the runs apart."""
    folders = Counter(run.folder.resolve() for run in runs)
    folder, times = folders.most_common(1)[0]
    if times > 1:
        raise UserError(f"{folder} is given twice")
    methods = [str(run.settings["method"]) for run in runs]
    methods = [published.NAMES.get(method, method) for method in methods]
    names = [f"{m}: {r.folder.name}" for m, r in zip(methods, runs, strict=True)]
    paths = [f"{m}: {r.folder}" for m, r in zip(methods, runs, strict=True)]
    labels = []
    for method, name, path in zip(methods, names, paths, strict=True):
        if methods.count(method) == 1:
            labels.append(method)
        else:
            labels.append(name if names.count(name) == 1 else path)
    return labels
