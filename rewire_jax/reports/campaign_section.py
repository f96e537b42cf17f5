"""A section of a campaign's page: runs of a scenario that can be compared."""

import base64
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rewire_jax.reports import run_report, statistics
from rewire_jax.reports.campaign_data import CampaignData
from rewire_jax.reports.report import Report
from rewire_jax.reports.run_summary import (
    Comparison,
    comparable,
    final_samples,
    summarize,
)
from rewire_jax.reports.same_tasks import check_same_tasks
from rewire_jax.reports.spread import Interval
from rewire_jax.reports.statistics import Array, estimate, stratified_bootstrap
from rewire_jax.reports.table import Table
from rewire_jax.reports.titles import several
from rewire_jax.storage.merged_results import merged
from rewire_jax.storage.run_results import RunData

_THRESHOLDS = 101
IMPROVEMENT = (
    "A cell is the probability that a seed of the row's configuration has a higher "
    "score at the end than a seed of the column's on the same task, averaged over "
    "tasks, with its 95% interval. An interval that contains 0.5 shows no difference. "
    "The intervals are not corrected for the number of comparisons."
)
"""How to read `Section.improvement`."""


@dataclass(frozen=True)
class Section:
    """Comparable configurations, of which at least one seed is finished.

    Attributes:
        report: tables and pictures, as the report of runs has them.
        names: of the configurations, in the order of the tables.
        unfinished: a sentence for each configuration that lacks seeds.
        improvement: for each pair of configurations the probability that the first one
            is better; None for a configuration with itself, or without scores.
    """

    report: Report[Comparison]
    names: tuple[str, ...]
    unfinished: tuple[str, ...]
    improvement: tuple[tuple[Interval | None, ...], ...]

    @property
    def labels(self) -> list[str]:
        """Of the configurations, in the order of the tables."""
        return [summary.label for summary in self.report.numbers.summaries]

    def task_tables(self) -> tuple[Table, ...]:
        """Tables with a row for each configuration and task."""
        return run_report.task_tables(self.report.numbers)

    def pictures(self) -> list[tuple[str, str]]:
        """Title and data URI of each picture."""
        # Here, because Matplotlib takes long to import.
        from rewire_jax.reports.plots import plain_text

        titles = {**self.report.pictures, "profiles.png": "Performance profiles"}
        with TemporaryDirectory() as made, plain_text():
            folder = Path(made)
            self.report.draw(folder)
            _draw_profiles(self.report, folder / "profiles.png")
            return [
                (title, _uri(folder / name))
                for name, title in titles.items()
                if (folder / name).exists()
            ]


def _uri(picture: Path) -> str:
    text = base64.b64encode(picture.read_bytes()).decode()
    return f"data:image/png;base64,{text}"


def sections(data: CampaignData) -> list[Section]:
    """The sections of a campaign, in the order of its file.

    The seeds of a configuration count as one run, whether they were trained together or
    not.
    """
    runs: dict[tuple[str, str], list[RunData]] = defaultdict(list)
    for job in data.jobs:
        if job.run.name in data.finished:
            key = job.run.settings.scenario, job.run.configuration
            runs[key].append(data.finished[job.run.name])
    planned = Counter(
        (run.settings.scenario, run.configuration) for run in data.campaign.runs
    )
    groups: dict[tuple[object, ...], dict[str, RunData]] = defaultdict(dict)
    for scenario, name in planned:
        if (scenario, name) in runs:
            check_same_tasks(runs[scenario, name])
            run = merged(runs[scenario, name])
            groups[comparable(run)][name] = run
    return [_section(group, planned) for group in groups.values()]


def _section(group: dict[str, RunData], planned: Counter[tuple[str, str]]) -> Section:
    """The section of runs by configuration; `planned` are numbers of seeds."""
    comparison = summarize([*group.values()], names=[*group])
    first = comparison.summaries[0].run
    scenario, unfinished = str(first.settings["scenario"]), []
    for name, summary in zip(group, comparison.summaries, strict=True):
        done, count = len(summary.run.seeds), planned[scenario, name]
        if done < count:
            said = f"{done} of {several(count, 'seed')}"
            unfinished.append(f"{summary.label}: only {said} finished.")
    scores = [final_samples(s.run, None)[0] for s in comparison.summaries]
    count = len(scores)
    pairs: list[list[Interval | None]] = [[None] * count for _ in range(count)]
    for i in range(count):
        for j in range(i):
            if scores[i].size and scores[j].size:
                of = statistics.probability_of_improvement
                pairs[i][j] = estimate(of, scores[i], scores[j])
                pairs[j][i] = _complement(pairs[i][j])
    return Section(
        report=run_report.make(comparison, first.folder.parent),
        names=tuple(group),
        unfinished=tuple(unfinished),
        improvement=tuple(map(tuple, pairs)),
    )


def _complement(probability: Interval | None) -> Interval | None:
    """The probability of the contrary."""
    if probability is None or probability.value is None:
        return None
    low, high = (
        None if end is None else 1 - end for end in (probability.high, probability.low)
    )
    return Interval(1 - probability.value, low, high)


def _draw_profiles(report: Report[Comparison], path: Path) -> None:
    # Here, because Matplotlib takes long to import.
    from rewire_jax.reports.profile_plot import Profile, profiles

    comparison = report.numbers
    scores = [final_samples(s.run, comparison.base) for s in comparison.summaries]
    values = np.concatenate([_ratio(*each).ravel() for each in scores])
    if not values.size:
        return
    low, high = comparison.score.limits or (values.min(), values.max())
    thresholds = np.linspace(low, high if high > low else low + 1, _THRESHOLDS)

    def shares(*samples: Array) -> Array:
        return statistics.performance_profile(_ratio(*samples), thresholds)

    lines = []
    for summary, samples in zip(comparison.summaries, scores, strict=True):
        profile, interval = None, None
        if samples[0].size:
            profile, interval = shares(*samples), stratified_bootstrap(shares, *samples)
        lines.append(Profile(summary.label, profile, interval))
    profiles(lines, thresholds, comparison.unit, report.title, path)


def _ratio(scores: Array, divisor: Array | None = None) -> Array:
    """Scores over the mean of a divisor, both `[..., seeds, tasks]`."""
    if divisor is None:
        return scores
    return scores / statistics.mean(divisor)[..., None, None]
