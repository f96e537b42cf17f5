"""Tables, a picture and a result file of a sweep, from its files alone."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from rewire_jax.core.errors import writing
from rewire_jax.reports import run_tables, sweep_tables
from rewire_jax.reports.sweep_summary import (
    Configuration,
    Panel,
    SweepSummary,
    summarize_sweep,
)
from rewire_jax.reports.sweep_tables import UNIT, settings_text
from rewire_jax.reports.titles import heading
from rewire_jax.storage.sweep_results import read_sweep

_READING = (
    "Performance is the return of deterministic evaluations, averaged over the tasks "
    "trained by then: mean ± sample standard deviation over seeds, and the mean's "
    "bootstrap interval over seeds, too narrow where these are few. Configurations are "
    "ranked by other episodes than those reported, so that the best's performance is "
    "free of their luck, though not of its seeds'. Those that came further stand "
    "before the others, among them those with fewer diverged seeds, among these those "
    "of higher mean. A diverged seed is left out of means. The tables by value are of "
    "the configurations that came as far as any, their means ± the standard deviation "
    "over them."
)


@dataclass(frozen=True)
class SweepReport:
    """What was written, and the numbers in it.

    Attributes:
        title: scenario, method, profile, budget, backend, members.
        notes: what a reader must know: the best settings and what is as good, what is
            unfinished, halved away or diverged.
        summary: the numbers.
        markdown: the tables for people.
        members: CSV, a row for each member and stage.
        configurations: CSV, a row for each configuration, the best first.
        json: all numbers, with settings and provenance.
        picture: performance along each axis, the paper's Fig. 6.
    """

    title: str
    notes: tuple[str, ...]
    summary: SweepSummary
    markdown: Path
    members: Path
    configurations: Path
    json: Path
    picture: Path

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of the report."""
        data = self.markdown, self.members, self.configurations, self.json
        return *data, self.picture


def write_sweep_report(
    folder: str | Path, out: str | Path | None = None
) -> SweepReport:
    """Writes the report of a sweep, finished or not.

    Args:
        folder: of the sweep.
        out: the folder to write into, by default the sweep's; an old report is
            replaced.

    Raises:
        UserError: the sweep cannot be read or has no results yet, or `out` cannot be
            written.
    """
    summary = summarize_sweep(read_sweep(folder))
    out = Path(folder if out is None else out)
    report = SweepReport(
        title=_title(summary),
        notes=tuple(_notes(summary)),
        summary=summary,
        markdown=out / "sweep.md",
        members=out / "members.csv",
        configurations=out / "configurations.csv",
        json=out / "sweep.json",
        picture=out / "panels.png",
    )
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        text = sweep_tables.members_csv(summary)
        report.members.write_text(text, encoding="utf-8")
        text = sweep_tables.configurations_csv(summary)
        report.configurations.write_text(text, encoding="utf-8")
        report.markdown.write_text(_markdown(report), encoding="utf-8")
        report.json.write_text(_json(report), encoding="utf-8")
        _draw(report)
    return report


def _title(summary: SweepSummary) -> str:
    sweep = summary.sweep
    subject = f"{sweep.settings['scenario']}, {sweep.settings['method']}"
    configurations, seeds = len(summary.configurations), len(set(sweep.seeds.tolist()))
    members = f"{configurations} configurations"
    if configurations == 1:
        members = "1 configuration"
    members += f" × {seeds} seed{'' if seeds == 1 else 's'}"
    return heading(subject, sweep.settings, len(sweep.tasks), members)


def _notes(summary: SweepSummary) -> Iterator[str]:
    sweep, best = summary.sweep, summary.best
    if best is None:
        yield "There is no best configuration yet: no seed of any is left or evaluated."
    else:
        count = len(best.kept)
        yield (
            f"Best: {settings_text(best.values)}; performance after "
            f"{_tasks(best.stage)} {run_tables.interval(best.interval)}, "
            + (
                "of one seed, which tells settings apart by chance."
                if count == 1
                else f"95% interval of {count} seeds."
            )
        )
        found = len(summary.contenders)
        if found:
            yield (
                f"Others whose interval reaches its own: {found}. This sweep does not "
                "tell these apart."
            )
    if not sweep.complete:
        yield (
            f"Unfinished: {sweep.finished} of {_tasks(len(sweep.tasks))} are trained "
            "and evaluated for all members."
        )
    stopped = sum(each.stopped for each in summary.configurations)
    if stopped:
        yield (
            f"{stopped} configurations were halved away before the end; their "
            "performance is of the tasks trained by then."
        )
    lost = sum(len(each.diverged) for each in summary.configurations)
    if lost:
        some = "1 member" if lost == 1 else f"{lost} members"
        yield f"{some} of {len(sweep.seeds)} diverged."


def _tasks(count: int) -> str:
    return f"{count} task{'' if count == 1 else 's'}"


def _markdown(report: SweepReport) -> str:
    summary = report.summary
    lines = [f"# {report.title}", ""]
    for note in report.notes:
        lines += [f"**{note}**", ""]
    lines += run_tables.markdown(*sweep_tables.ranking(summary))
    picture = f"![Performance along each axis]({report.picture.name})"
    lines += [_READING, "", picture, "", _reading(summary), ""]
    for panel in summary.panels:
        lines += [f"## {panel.axis}", ""]
        lines += run_tables.markdown(*sweep_tables.values(summary, panel))
    lost = sweep_tables.lost(summary)
    if lost.rows:
        lines += ["## What diverged", "", *run_tables.markdown(*lost)]
    return "\n".join([*lines, "## How it was made", "", *_origin(summary)]) + "\n"


def _reading(summary: SweepSummary) -> str:
    """How to read the picture."""
    text = "Mean over seeds"
    if any(each.performance.std is not None for each in summary.configurations):
        text += ", bars: standard deviation"
    text += "; orange: the best"
    if any(each.stage < summary.stage for each in summary.configurations):
        text += "; hollow: after fewer tasks"
    if summary.sweep.random or len(summary.panels) < 2:
        return f"{text}."
    # A panel names the values of all axes but its own.
    centre = {
        panel.axis: summary.panels[place - 1].others[panel.axis]
        for place, panel in enumerate(summary.panels)
    }
    best = summary.best is not None and summary.best.values == centre
    where = "at their best" if best else "where the lines of the sweep cross"
    return f"{text}; the other axes {where}: {settings_text(centre)}."


def _draw(report: SweepReport) -> None:
    # Here, because Matplotlib takes long to import.
    from rewire_jax.reports.sensitivity_plot import Dot, panels

    summary = report.summary

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
        report.title,
        _reading(summary),
        report.picture,
        joined=not summary.sweep.random,
    )


def _origin(summary: SweepSummary) -> list[str]:
    """Where the numbers come from."""
    sweep = summary.sweep
    made = sweep.provenance
    versions = ", ".join(f"{k} {v}" for k, v in dict(made.get("versions", {})).items())
    seeds = ", ".join(str(seed) for seed in sorted(set(sweep.seeds.tolist())))
    training, selection = (
        int(np.nanmax(values, axis=1, initial=0).sum())
        for values in (sweep.training, sweep.selection)
    )
    return [
        f"- `{sweep.folder}`: {len(sweep.seeds)} members, seeds {seeds}",
        *(f"- {key} `{made.get(key)}`" for key in ("command", "commit", "started")),
        f"- device: {made.get('device')}; versions: {versions}",
        f"- {int(sweep.settings['interactions']):,} interactions a task; all members "
        f"together {training:,} of training and {selection:,} of selection, in "
        f"{sweep.hours:.2f} hours of training",
    ]


def _json(report: SweepReport) -> str:
    summary = report.summary
    sweep = summary.sweep
    data = {
        "format": 1,
        "title": report.title,
        "notes": report.notes,
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
    return run_tables.json_text(data)
