"""From the results of runs to the numbers that a report shows."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.arguments import require
from rewire_jax.core.errors import UserError
from rewire_jax.reports import metrics, paper_results, statistics
from rewire_jax.reports.paper_results import Figures, Source
from rewire_jax.reports.same_tasks import check_same_tasks
from rewire_jax.reports.spread import Interval, Spread, spread
from rewire_jax.reports.statistics import estimate
from rewire_jax.storage.run_results import RunData
from rewire_jax.storage.scores import Score

Array = NDArray[np.float64]
Tasks = tuple[dict[str, Spread], ...]

# Runs that differ in one of these are not comparable and share no table; with what
# earlier runs had, where they do not say.
_SHARED = {
    "scenario": None,
    "profile": None,
    "backend": None,
    "interactions": None,
    "reward": "v2",
}
# The measures of a task, in a table's order, with their headings.
MEASURES = {
    "before": "before the first task",
    "after": "right after own training",
    "end": "at the end",
    "forgetting": "forgetting",
}


@dataclass(frozen=True)
class Summary:
    """A run's numbers; its diverged seeds are left out.

    Where a SAC-N run normalises, all but `tasks` are multiples of its performance.

    Attributes:
        label: the method as the paper calls it, with the folder's name where two runs
            share a method.
        run: what was read.
        tasks: for each task of the sequence, scores of its `MEASURES`, and "transfer"
            where single-task runs are given; those of tasks not trained yet have no
            values but `before`.
        others: the same by the name of every other score that was measured.
        performance: score after the last finished stage, averaged over the tasks
            trained by then.
        iqm: interquartile mean of these scores over seeds and tasks, with its
            stratified bootstrap interval; SAC-N's seeds are drawn anew in it, too.
        forgetting: averaged over those tasks.
        transfer: forward transfer averaged over those tasks, where SAC-N normalises or
            single-task runs are given.
        published: the paper's result from each source, None where it has none or where
            several runs share the method.
    """

    label: str
    run: RunData
    tasks: Tasks
    others: dict[str, Tasks]
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
        score: what all of them are measured by.
        sources: where `Summary.published` is from.
        base: the SAC-N run that normalises; None if scores are raw.
        raw: why scores are raw returns; None where SAC-N normalises them, and for
            scores that are not to be normalised.
        single: what learned one of the tasks alone, that forward transfer is measured
            from.
    """

    summaries: tuple[Summary, ...]
    score: Score
    sources: tuple[Source, ...]
    base: RunData | None
    raw: str | None
    single: tuple[RunData, ...]

    @property
    def normalised(self) -> bool:
        """Whether scores are multiples of SAC-N's."""
        return self.base is not None

    @property
    def unit(self) -> str:
        """What scores are measured in."""
        return "÷ SAC-N" if self.normalised else self.score.unit

    @property
    def transferred(self) -> bool:
        """Whether there is something that forward transfer can be measured from."""
        return self.score.normalised or bool(self.single)

    @property
    def stored(self) -> bool:
        """Whether a method stores states, which reports list apart from its size."""
        return any(summary.run.stored_states for summary in self.summaries)

    @property
    def measures(self) -> dict[str, str]:
        """The measures of a task, with their headings."""
        return MEASURES | ({"transfer": "forward transfer"} if self.single else {})


def comparable(run: RunData) -> tuple[Any, ...]:
    """What is equal in runs that share a table."""
    settings = (run.settings.get(name, old) for name, old in _SHARED.items())
    return (*settings, run.score.noun, run.tasks)


def summarize(
    runs: Sequence[RunData],
    single: Sequence[RunData] = (),
    names: Sequence[str] | None = None,
) -> Comparison:
    """Summarizes comparable runs.

    Args:
        runs: one or more, complete or partial.
        single: finished runs of one task each, from which forward transfer is measured.
        names: of the runs' configurations, all different: they label the runs, and the
            paper's result of a method is that of the configuration of its name.

    Raises:
        UserError: there is no run, one is given twice, they are not comparable, or a
            task lacks its single-task run.
    """
    require(bool(runs), "no run to report on: name the folder of one or more")
    first = runs[0]
    for run in runs[1:]:
        _check(run, first, *_SHARED)
        same = run.tasks == first.tasks
        require(same, f"cannot compare {run.folder} with {first.folder}: other tasks")
    check_same_tasks([*runs, *single])
    areas = _alone(single, first)
    base, raw = _reference(runs) if first.score.normalised else (None, None)
    sources = paper_results.sources(
        first.settings["scenario"], first.settings["backend"]
    )
    labels = _labels(runs) if names is None else list(map(_shown, names))
    summaries = []
    for run, label, name in zip(runs, labels, names or _methods(runs), strict=True):
        theirs = tuple(source.results.get(name) for source in sources)
        summaries.append(_summary(run, label, base, areas, theirs))
    return Comparison(tuple(summaries), first.score, sources, base, raw, tuple(single))


def _check(run: RunData, other: RunData, *names: str) -> None:
    """Runs are comparable in these settings, and in what they are measured by."""
    facts = [
        {name: each.settings.get(name, _SHARED[name]) for name in names}
        | {"measured by": each.score.noun}
        for each in (run, other)
    ]
    for name, mine in facts[0].items():
        if mine != facts[1][name]:
            raise UserError(
                f"cannot compare {run.folder} ({name} {mine}) with "
                f"{other.folder} ({name} {facts[1][name]})"
            )


def _alone(single: Sequence[RunData], first: RunData) -> dict[str, float]:
    """By the name of a task, its `metrics.area` where it is learned alone."""
    if not single:
        return {}
    if first.score.normalised:
        raise UserError(
            f"single-task runs serve success rates, and {first.folder} has none"
        )
    alone: dict[str, float] = {}
    for run in single:
        _check(run, first, *(name for name in _SHARED if name != "scenario"))
        if len(run.tasks) > 1 or not run.complete or not run.kept.any():
            raise UserError(f"{run.folder} is not a finished run of a single task")
        if run.tasks[0] in alone:
            raise UserError(f"there are two single-task runs of {run.tasks[0]}")
        alone[run.tasks[0]] = float(_areas(run, 1).mean())
    missing = [name for name in dict.fromkeys(first.tasks) if name not in alone]
    if missing:
        raise UserError(f"there is no single-task run of {', '.join(missing)}")
    return alone


def _areas(run: RunData, done: int) -> Array:
    """`[kept seeds, done]`: mean score over the training of each of the first tasks."""
    areas = [metrics.area(x, values[run.kept]) for x, values in run.curve[:done]]
    return np.reshape(areas, (done, run.kept.sum())).T


def _reference(runs: Sequence[RunData]) -> tuple[RunData | None, str | None]:
    """The SAC-N run that normalises all runs, or None and why there is none."""
    found = [
        run for run in runs if run.settings["method"] == "sac_n" and not run.segments
    ]
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


def _matrix(run: RunData, done: int, score: Score | None = None) -> Array:
    """`[kept seeds, done, done]`: the first tasks are a sequence of their own."""
    return run.measured[score or run.score][run.kept, 1 : done + 1, :done]


def _summary(
    run: RunData,
    label: str,
    base: RunData | None,
    areas: dict[str, float],
    theirs: tuple[Figures | None, ...],
) -> Summary:
    performance = forgetting = transfer = np.zeros(0)
    iqm = Interval(None, None, None)
    own: dict[str, Array] = {}
    if areas:
        alone = [areas[name] for name in run.tasks[: run.finished]]
        own["transfer"] = metrics.area_transfer(_areas(run, run.finished), alone)
    if run.finished:
        matrix = _matrix(run, run.finished)
        iqm = _iqm(run, base)
        if base:
            # SAC-N as it was after as many tasks, the mean over its seeds.
            other = _matrix(base, run.finished).mean(axis=0)
            scale = metrics.final(other)
            matrix = metrics.normalise(matrix, scale)
            fresh = metrics.normalise(metrics.after_own_training(other), scale)
            transfer = metrics.forward_transfer(matrix, fresh).mean(axis=-1)
        if areas:
            transfer = own["transfer"].mean(axis=-1)
        performance = metrics.performance(matrix)
        forgetting = metrics.forgetting(matrix).mean(axis=-1)
    others = [each for each in run.measured if each != run.score]
    return Summary(
        label=label,
        run=run,
        tasks=_tasks(run, run.score, own),
        others={score.name: _tasks(run, score, {}) for score in others},
        performance=spread(performance),
        iqm=iqm,
        forgetting=spread(forgetting),
        transfer=spread(transfer),
        published=theirs,
    )


def _tasks(run: RunData, score: Score, own: dict[str, Array]) -> Tasks:
    """Scores of each task, see `Summary.tasks`, and other measures of its own."""
    columns = own | {"before": run.measured[score][run.kept, 0]}
    if run.finished:
        matrix = _matrix(run, run.finished, score)
        columns["after"] = metrics.after_own_training(matrix)
        columns["end"] = metrics.final(matrix)
        columns["forgetting"] = metrics.forgetting(matrix)
    empty = np.zeros(0)
    return tuple(
        {
            name: spread(values[:, task])
            if (values := columns.get(name)) is not None and task < values.shape[1]
            else spread(empty)
            for name in (*MEASURES, *own)
        }
        for task in range(len(run.tasks))
    )


def final_samples(run: RunData, base: RunData | None) -> tuple[Array, ...]:
    """What statistics of a run are estimated from.

    Returns:
        Scores after the last finished stage, `[seeds, tasks]`, and those of SAC-N after
        as many, where it divides them. For SAC-N itself both are the same array.
        Diverged seeds and those with NaN are left out.
    """
    scores = _final(run, run.finished)
    if base is None:
        return (scores,)
    return scores, scores if run is base else _final(base, run.finished)


def _final(run: RunData, done: int) -> Array:
    scores = metrics.final(_matrix(run, done))
    return scores[~np.isnan(scores).any(axis=1)]


def _iqm(run: RunData, base: RunData | None) -> Interval:
    of = statistics.normalised_iqm if base else statistics.interquartile_mean
    return estimate(of, *final_samples(run, base))


def _methods(runs: Sequence[RunData]) -> list[str]:
    """The runs' methods, empty where several runs share one.

    The paper has one result a method: it belongs to none of several variants.
    """
    methods = [str(run.settings["method"]) for run in runs]
    return [method if methods.count(method) == 1 else "" for method in methods]


def _shown(name: str) -> str:
    return paper_results.LABELS.get(name, name)


def _labels(runs: Sequence[RunData]) -> list[str]:
    """The shortest of method, folder name, path that tells the runs apart."""
    folders = Counter(run.folder.resolve() for run in runs)
    folder, times = folders.most_common(1)[0]
    if times > 1:
        raise UserError(f"{folder} is given twice")
    methods = [_shown(str(run.settings["method"])) for run in runs]
    names = [f"{m}: {r.folder.name}" for m, r in zip(methods, runs, strict=True)]
    paths = [f"{m}: {r.folder}" for m, r in zip(methods, runs, strict=True)]
    labels = []
    for method, name, path in zip(methods, names, paths, strict=True):
        if methods.count(method) == 1:
            labels.append(method)
        else:
            labels.append(name if names.count(name) == 1 else path)
    return labels
