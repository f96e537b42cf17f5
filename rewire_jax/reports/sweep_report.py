"""What the report of a sweep has."""

from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from rewire_jax.reports import sweep_tables
from rewire_jax.reports.data_files import json_text
from rewire_jax.reports.provenance import origin
from rewire_jax.reports.report import Report
from rewire_jax.reports.sweep_summary import Configuration, Panel, SweepSummary
from rewire_jax.reports.sweep_tables import UNIT, settings_text
from rewire_jax.reports.table import to_markdown
from rewire_jax.reports.titles import heading, several

_READING = (
    "Performance is the return of deterministic evaluations, averaged over the tasks "
    "trained by then: mean ± sample standard deviation over seeds, and the mean with "
    "its bootstrap interval over seeds, which is too narrow where seeds are few. "
    "Configurations are ranked by other episodes than those of their performance, so "
    "the best one's performance is not raised by lucky episodes; it may be by lucky "
    "seeds. Those that trained more tasks come first, then those with fewer diverged "
    "seeds, then those with a higher mean. Means leave diverged seeds out. The tables "
    "for single settings show means ± standard deviation over the configurations that "
    "trained the most tasks."
)


def make(summary: SweepSummary, folder: Path) -> Report[SweepSummary]:
    """The report of a sweep; nothing is written.

    Args:
        summary: the numbers.
        folder: folder of the report.
    """
    title, notes = _title(summary), tuple(_notes(summary))
    ranking = sweep_tables.ranking(summary)
    return Report(
        folder=folder,
        name="sweep.md",
        title=title,
        notes=notes,
        numbers=summary,
        table=ranking,
        shown=(ranking,),
        reading=(_READING,),
        texts={
            "members.csv": sweep_tables.members_csv(summary),
            "configurations.csv": sweep_tables.configurations_csv(summary),
            "sweep.json": _json(summary, title, notes),
        },
        pictures={"panels.png": "Performance along each axis"},
        draw=partial(_draw, summary, title),
        details=list(_details(summary)),
        origins=list(_origins(summary)),
    )


def _title(summary: SweepSummary) -> str:
    sweep = summary.sweep
    subject = f"{sweep.settings['scenario']}, {sweep.settings['method']}"
    count, seeds = len(summary.configurations), len(set(sweep.seeds.tolist()))
    return heading(subject, sweep.settings, len(sweep.tasks), [seeds], count)


def _notes(summary: SweepSummary) -> Iterator[str]:
    sweep, best = summary.sweep, summary.best
    if best is None:
        yield "There is no best configuration yet: no seed of any is left or evaluated."
    else:
        count = len(best.kept)
        trust = f"95% interval of {count} seeds."
        if count == 1:
            trust = "of one seed, which tells settings apart by chance."
        yield (
            f"Best: {settings_text(best.values)}; performance after "
            f"{several(best.stage, 'task')} {best.interval}, {trust}"
        )
        found = len(summary.contenders)
        if found:
            overlap = "overlaps" if found == 1 else "overlap"
            yield (
                f"{several(found, 'other configuration')} {overlap} the best one's "
                "interval: this sweep does not tell them apart."
            )
    if not sweep.complete:
        yield (
            f"Unfinished: {sweep.finished} of {several(len(sweep.tasks), 'task')} are "
            "trained and evaluated for all members."
        )
    stopped = sum(each.stopped for each in summary.configurations)
    if stopped:
        yield (
            f"{stopped} configurations were halved away before the end; their "
            "performance is of the tasks trained by then."
        )
    lost = sum(len(each.diverged) for each in summary.configurations)
    if lost:
        yield f"{several(lost, 'member')} of {len(sweep.seeds)} diverged."


def _details(summary: SweepSummary) -> Iterator[str]:
    yield from (_reading(summary), "")
    for panel in summary.panels:
        yield from (f"## {panel.axis}", "")
        yield from to_markdown(*sweep_tables.values(summary, panel))
    lost = sweep_tables.lost(summary)
    if lost.rows:
        yield from ("## Diverged", "", *to_markdown(*lost))
    yield from ("## Origin", "")


def _reading(summary: SweepSummary) -> str:
    """How to read the picture."""
    text = "Points: mean over seeds."
    if any(each.performance.std is not None for each in summary.configurations):
        text += " Bars: standard deviation."
    text += " Orange: the best."
    if any(each.stage < summary.stage for each in summary.configurations):
        text += " Hollow: after fewer tasks."
    if summary.sweep.random or len(summary.panels) < 2:
        return text
    # A panel names the values of all axes but its own.
    centre = {
        panel.axis: summary.panels[place - 1].others[panel.axis]
        for place, panel in enumerate(summary.panels)
    }
    best = summary.best is not None and summary.best.values == centre
    where = "at their best" if best else "where the lines of the sweep cross"
    others = f"the others are {where}: {settings_text(centre)}."
    return f"{text} Each panel varies one setting; {others}"


def _draw(summary: SweepSummary, title: str, folder: Path) -> None:
    # Here, because Matplotlib takes long to import.
    from rewire_jax.reports.sensitivity_plot import Dot, panels

    def dot(panel: Panel, each: Configuration) -> Dot:
        mean = each.performance.mean
        return Dot(
            value=each.values[panel.axis],
            mean=np.nan if mean is None else mean,
            std=each.performance.std,
            whole=each.stage == summary.stage,
            best=each is summary.best,
        )

    panels(
        [(p.axis, [dot(p, each) for each in p.line]) for p in summary.panels],
        UNIT,
        title,
        _reading(summary),
        folder / "panels.png",
        joined=not summary.sweep.random,
    )


def _origins(summary: SweepSummary) -> Iterator[str]:
    sweep = summary.sweep
    yield origin(several(len(sweep.seeds), "member"), sweep)
    training, selection = (
        int(np.nanmax(values, axis=1, initial=0).sum())
        for values in (sweep.training, sweep.selection)
    )
    yield (
        f"- all members together: {training:,} interactions of training and "
        f"{selection:,} of selection, in {sweep.hours:.2f} hours of training"
    )


def _json(summary: SweepSummary, title: str, notes: tuple[str, ...]) -> str:
    sweep = summary.sweep
    data = {
        "format": 1,
        "title": title,
        "notes": notes,
        "unit": UNIT,
        "tasks": sweep.tasks,
        "finished_tasks": sweep.finished,
        "complete": sweep.complete,
        "random": sweep.random,
        "halving": sweep.halving,
        "axes": {name: sorted(set(axis.tolist())) for name, axis in sweep.axes.items()},
        "best": summary.best and summary.best.index,
        "contenders": [each.index for each in summary.contenders],
        "configurations": [asdict(each) for each in summary.configurations],
        "panels": [
            {
                "axis": panel.axis,
                "others": panel.others,
                "configurations": [each.index for each in panel.line],
            }
            for panel in summary.panels
        ],
        "members": [
            {
                "member": member,
                "configuration": int(sweep.configurations[member]),
                "seed": int(sweep.seeds[member]),
                "stages": int(sweep.reached[member]),
                "diverged": sweep.diverged[member].tolist(),
                "scores": sweep.scores[member].tolist(),
                "choice": sweep.choice[member].tolist(),
            }
            for member in range(len(sweep.seeds))
        ],
        "hours": sweep.hours,
        "settings": sweep.settings,
        "provenance": sweep.provenance,
    }
    return json_text(data)
