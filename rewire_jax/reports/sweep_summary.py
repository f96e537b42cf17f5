"""From the results of a sweep to the numbers that its report shows."""

from dataclasses import dataclass

import numpy as np

from rewire_jax.reports import metrics
from rewire_jax.reports.spread import Interval, Spread, spread
from rewire_jax.reports.statistics import estimate, mean
from rewire_jax.run.ranking import rank
from rewire_jax.storage.result_files import Array
from rewire_jax.storage.sweep_results import SweepData


@dataclass(frozen=True)
class Configuration:
    """One configuration's numbers; its diverged seeds are left out of them.

    Attributes:
        index: its number in the sweep.
        values: values by axis.
        members: their numbers.
        stage: after how many tasks its numbers are.
        stopped: whether it was halved away there.
        kept: the seeds that count.
        diverged: those that do not.
        performance: return after that stage, averaged over the tasks trained by then.
        interval: its mean with the bootstrap interval over seeds.
        choice: the same as `performance`, of the episodes by which it is ranked.
    """

    index: int
    values: dict[str, float]
    members: tuple[int, ...]
    stage: int
    stopped: bool
    kept: tuple[int, ...]
    diverged: tuple[int, ...]
    performance: Spread
    interval: Interval
    choice: Spread


@dataclass(frozen=True)
class Panel:
    """An axis, with the configurations that differ along it alone.

    Attributes:
        axis: its name.
        others: values of the other axes, common to them; of a random sweep none.
        line: the configurations by value; of a random sweep all.
    """

    axis: str
    others: dict[str, float]
    line: tuple[Configuration, ...]


@dataclass(frozen=True)
class SweepSummary:
    """A sweep's numbers.

    Attributes:
        sweep: what was read.
        stage: after how many tasks configurations are compared.
        configurations: the best first: those that came further before the others,
            among them as `ranking.rank` has it by their `choice`.
        panels: one for each axis.
    """

    sweep: SweepData
    stage: int
    configurations: tuple[Configuration, ...]
    panels: tuple[Panel, ...]

    @property
    def best(self) -> Configuration | None:
        """The first of them; None where every seed diverged or there is no result."""
        first = self.configurations[0]
        return first if first.kept else None

    @property
    def contenders(self) -> list[Configuration]:
        """Those that came as far as the best and whose interval reaches its own."""
        best = self.best
        return [
            other
            for other in self.configurations
            if best is not None
            and best.interval.low is not None
            and other is not best
            and other.stage == best.stage
            and other.interval.high is not None
            and other.interval.high >= best.interval.low
        ]


def performance(scores: Array) -> Array:
    """Return after each stage, averaged over the tasks trained by then.

    Args:
        scores: `[members, T stages, T tasks]`.

    Returns:
        `[members, T]`.
    """
    squares = (scores[:, : k + 1, : k + 1] for k in range(scores.shape[1]))
    return np.stack([metrics.performance(square) for square in squares], axis=1)


def summarize_sweep(sweep: SweepData) -> SweepSummary:
    """Summarizes a sweep, as far as it has come."""
    # Where the first stage is still under way, those that are through it come first.
    stage = max(sweep.finished, 1)
    reported, chosen = performance(sweep.scores), performance(sweep.choice)
    groups = [
        np.flatnonzero(sweep.configurations == index)
        for index in np.unique(sweep.configurations)
    ]
    found = [_configuration(sweep, g, stage, reported, chosen) for g in groups]
    order = []
    for came in sorted({each.stage for each in found}, reverse=True):
        level = [each for each in found if each.stage == came]
        # Seeds that do not count are NaN, and there may be more of one than another.
        seeds = max(len(each.members) for each in level)
        scores = np.full((len(level), seeds), np.nan)
        for row, each in zip(scores, level, strict=True):
            row[: len(each.kept)] = each.choice.values
        order += [level[i] for i in rank(scores)]
    panels = tuple(_panel(order, axis, sweep.random > 0) for axis in sweep.axes)
    return SweepSummary(sweep, stage, tuple(order), panels)


def _configuration(
    sweep: SweepData,
    members: np.ndarray,
    stage: int,
    reported: Array,
    chosen: Array,
) -> Configuration:
    came = min(int(sweep.reached[members].min()), stage)
    last = max(came - 1, 0)
    lost = sweep.diverged[members, last]
    # A return that is not finite counts no more than a member that was marked.
    lost |= ~np.isfinite(reported[members, last] + chosen[members, last])
    lost &= came > 0
    there = members[~lost] if came else members[:0]
    returns = reported[there, last]
    return Configuration(
        index=int(sweep.configurations[members[0]]),
        values={name: float(axis[members[0]]) for name, axis in sweep.axes.items()},
        members=tuple(members.tolist()),
        stage=came,
        stopped=bool(sweep.stopped[members, last].any()),
        kept=tuple(sweep.seeds[there].tolist()),
        diverged=tuple(sweep.seeds[members[lost]].tolist()),
        performance=spread(returns),
        interval=estimate(mean, returns[:, None]),
        choice=spread(chosen[there, last]),
    )


def _panel(order: list[Configuration], axis: str, drawn: bool) -> Panel:
    """The panel of an axis; of configurations in their order."""
    if drawn:
        # No two draws have anything in common.
        line, others = order, {}
    else:
        centre = _centre(order)
        line = [each for each in order if _differences(each, centre) <= {axis}]
        others = {name: x for name, x in centre.values.items() if name != axis}
    line = sorted(line, key=lambda each: each.values[axis])
    return Panel(axis, others, tuple(line))


def _centre(order: list[Configuration]) -> Configuration:
    """The best of those from which most others differ along one axis alone.

    In a grid these are all. In a list of lines through one point it is that point.
    """
    near = [
        sum(len(_differences(each, other)) <= 1 for other in order) for each in order
    ]
    return order[near.index(max(near))]


def _differences(one: Configuration, other: Configuration) -> set[str]:
    return {name for name, x in one.values.items() if x != other.values[name]}
