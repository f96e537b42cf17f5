"""Performances averaged over scenarios, as in the paper's tables."""

import statistics
from collections.abc import Sequence
from typing import Any, NamedTuple

from rewire_jax.reports.paper_results import Figures
from rewire_jax.reports.report import Report
from rewire_jax.reports.run_summary import Comparison, Summary

AVERAGED = (
    "Over several scenarios, means and standard deviations over seeds are averaged. "
    "Unfinished runs are left out. Model size is in plain policies."
)
READING = (
    "Performance is the return after the last task, averaged over tasks and divided by "
    f"that of SAC-N. {AVERAGED} The paper's results were made on Brax v1 "
    "(`--backend v1`)."
)


class Average(NamedTuple):
    """What the runs of a name have in common.

    Attributes:
      mean: performance in its reports' unit, the mean over scenarios of that over
        seeds.
      std: the mean over scenarios of the standard deviation over seeds; None with a
        single seed.
      size: model size, the mean over scenarios.
      scenarios: how many these are.
    """

    mean: float
    std: float | None
    size: float
    scenarios: int


def over_scenarios(made: Sequence[Report[Comparison]]) -> dict[str, Average]:
    """Averages over scenarios by name of the run's folder.

    Runs that are not finished, or that no SAC-N run normalises where one should, have
    no part in them.
    """
    found: dict[str, list[Summary]] = {}
    for report in made:
        for summary in () if report.numbers.raw else report.numbers.summaries:
            if summary.run.complete and summary.performance.values:
                found.setdefault(summary.run.folder.name, []).append(summary)
    return {name: _average(summaries) for name, summaries in found.items()}


def _average(summaries: Sequence[Summary]) -> Average:
    stds = [s.performance.std for s in summaries]
    return Average(
        mean=statistics.mean(s.performance.mean or 0.0 for s in summaries),
        std=None if None in stds else statistics.mean(x for x in stds if x is not None),
        size=statistics.mean(s.run.model_size for s in summaries),
        scenarios=len(summaries),
    )


def text(value: Average | Figures | None, scenarios: int = 1) -> str:
    """A performance as tables show it; says so if it is not of all scenarios."""
    if value is None:
        return "–"
    shown = f"{value.mean:.2f}"
    if value.std is not None:
        shown += f" ± {value.std:.2f}"
    if isinstance(value, Average) and value.scenarios < scenarios:
        shown += f" ({value.scenarios} of {scenarios} scenarios)"
    return shown


def size(value: Average | Figures | None) -> str:
    """A model size as tables show it; the paper's has one decimal."""
    if value is None or value.size is None:
        return "–"
    return f"{value.size:.2f}" if isinstance(value, Average) else f"{value.size:.1f}"


def columns(prefix: str, value: Average | Figures | None) -> dict[str, Any]:
    """The same as numbers, for `write`."""
    names = {"mean": "performance", "std": "performance_std", "size": "model_size"}
    return {prefix + to: getattr(value, name, None) for name, to in names.items()}
