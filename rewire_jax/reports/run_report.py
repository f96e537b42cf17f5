"""Tables, pictures and a result file of one or more runs, from their files alone."""

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from rewire_jax.core.errors import writing
from rewire_jax.core.settings import require
from rewire_jax.reports import run_tables
from rewire_jax.reports.run_summary import (
    MEASURES,
    Comparison,
    Summary,
    Tasks,
    summarize,
)
from rewire_jax.reports.titles import heading
from rewire_jax.storage.run_results import RunData, read_run
from rewire_jax.storage.scores import SUCCESS, Success

_READING = (
    "Performance is the score at the end, averaged over tasks; values are mean ± "
    "sample standard deviation over seeds. IQM is the interquartile mean of the tasks' "
    "scores at the end over all seeds, with its stratified bootstrap interval. "
    "Forgetting is the score at the end minus the score right after own training: "
    "negative means forgotten. Training and selection are interactions of each seed; "
    "hours are those of training."
)
_NORMALISED = (
    "÷ SAC-N: performance, IQM, forgetting and transfer are divided by the mean return "
    "of SAC-N at the end, averaged over tasks and seeds. Forward transfer is the score "
    "right after own training minus that of SAC-N."
)
_CONTINUAL_WORLD = (
    "Performance and forgetting are Continual World's, whose forgetting has the other "
    "sign."
)
_TRANSFER = (
    "Forward transfer is Continual World's: (AUC - AUC_b) / (1 - AUC_b) for each task, "
    "AUC being the success rate of training episodes, averaged over the task's "
    "interactions (progress reports that saw episodes end, weighted by the "
    "interactions since the last report), and AUC_b its mean over the seeds of a run "
    "that learns the task alone. It is undefined where AUC_b is 1."
)


@dataclass(frozen=True)
class Report:
    """What was written, and the numbers in it.

    Attributes:
        title: scenario, profile, budget, backend, seeds.
        notes: what a reader must know: raw returns, diverged seeds, unfinished runs.
        comparison: the numbers.
        markdown: the tables for people.
        csv: a row for each run, in the form of the paper's Table 1.
        tasks: a row for each run and task.
        json: the numbers by seed, with every run's settings and provenance.
        curves: picture of training over the sequence.
        matrix: picture of task × stage.
        tradeoff: picture of performance and model size, the paper's Fig. 4.
    """

    title: str
    notes: tuple[str, ...]
    comparison: Comparison
    markdown: Path
    csv: Path
    tasks: Path
    json: Path
    curves: Path
    matrix: Path
    tradeoff: Path

    @property
    def summaries(self) -> tuple[Summary, ...]:
        """The numbers, one entry for each run."""
        return self.comparison.summaries

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of the report."""
        data = self.markdown, self.csv, self.tasks, self.json
        return *data, self.curves, self.matrix, self.tradeoff


def write_report(
    runs: Sequence[str | Path],
    out: str | Path,
    *,
    single: Sequence[str | Path] = (),
    success: Success = "any",
) -> Report:
    """Writes the report of comparable runs.

    Runs that know success are measured by their success rates, others by returns.

    Args:
        runs: run folders, complete or partial.
        out: the folder to write into; made where missing, an old report is replaced.
        single: folders of finished runs that learn one task each, one for every task
            of the sequence: forward transfer of success rates is measured from them.
        success: which steps of an episode count: "any", or the "last" alone.

    Raises:
        UserError: a run cannot be read, the runs are not comparable, a task lacks its
            single-task run, or `out` cannot be written.
    """
    known = ", ".join(SUCCESS)
    require(success in SUCCESS, f"unknown success {success!r}: choose one of {known}")
    comparison = summarize(
        [read_run(run, success) for run in runs],
        [read_run(run, success) for run in single],
    )
    out = Path(out)
    report = Report(
        title=_title(comparison.summaries),
        notes=tuple(_notes(comparison)),
        comparison=comparison,
        markdown=out / "report.md",
        csv=out / "report.csv",
        tasks=out / "tasks.csv",
        json=out / "result.json",
        curves=out / "curves.png",
        matrix=out / "matrix.png",
        tradeoff=out / "tradeoff.png",
    )
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        report.markdown.write_text(_markdown(report), encoding="utf-8")
        report.csv.write_text(run_tables.results_csv(comparison), encoding="utf-8")
        report.tasks.write_text(run_tables.tasks_csv(comparison), encoding="utf-8")
        report.json.write_text(_json(report), encoding="utf-8")
        _draw(report)
    return report


def to_terminal(report: Report, width: int = 100) -> str:
    """The report's tables as plain text, for a command to print.

    Args:
        report: what `write_report` gave.
        width: columns to fill at most.
    """
    file = io.StringIO()
    console = Console(file=file, width=width, color_system=None, force_terminal=False)
    console.print(Text(report.title))
    # A terminal shows the end best, and is too narrow for all columns side by side.
    for make in (run_tables.tasks, run_tables.costs, run_tables.results):
        heads, rows = make(report.comparison)
        table = Table(
            box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True
        )
        for k, head in enumerate(heads):
            if head in run_tables.WORDS:
                table.add_column(head, overflow="fold")
            else:
                # The heading breaks between words, so that numbers need not.
                texts = head.split() + [row[k] for row in rows]
                table.add_column(head, justify="right", width=max(map(len, texts)))
        last = ""
        for method, *cells in rows:
            # A method is named once, at its first task.
            table.add_row(Text("" if method == last else method), *map(Text, cells))
            last = method
        console.print()
        console.print(table)
    console.print()
    for note in (*_reading(report.comparison), *report.notes):
        console.print(Text(note))
    console.print()
    for path in report.paths:
        # A path that is wrapped cannot be copied.
        console.print(Text(str(path)), soft_wrap=True)
    return file.getvalue()


def _reading(comparison: Comparison) -> Iterator[str]:
    score = comparison.score
    reading = f"{score.evaluated} {_READING}"
    if score.normalised:
        yield f"{reading} Forgetting of single tasks is in returns."
    else:
        yield f"{reading} {_CONTINUAL_WORLD}"
    if comparison.normalised:
        yield _NORMALISED
    if comparison.single:
        yield _TRANSFER
    for made in dict.fromkeys(source.made for source in comparison.sources):
        yield f"The paper's columns are its published results, {made}."


def _title(summaries: Sequence[Summary]) -> str:
    run = summaries[0].run
    counts = sorted({len(summary.run.seeds) for summary in summaries})
    seeds = " to ".join(str(count) for count in sorted({counts[0], counts[-1]}))
    members = f"{seeds} seed{'' if counts[-1] == 1 else 's'}"
    return heading(run.settings["scenario"], run.settings, len(run.tasks), members)


def _notes(comparison: Comparison) -> Iterator[str]:
    if comparison.raw:
        yield f"Scores are raw returns, not normalised: {comparison.raw}."
    for summary in comparison.summaries:
        run = summary.run
        if run.diverged:
            names = ", ".join(str(seed) for seed in run.diverged)
            some = f"seed {names} diverged and is"
            if len(run.diverged) > 1:
                some = f"seeds {names} diverged and are"
            yield f"{summary.label}: {some} left out of all means and pictures."
        if not run.complete:
            end = "there are no results after training yet"
            if run.finished:
                end = (
                    f'"{MEASURES["end"]}" is after task {run.finished}, and means are '
                    "over the tasks trained by then"
                )
            done = f"{run.finished} of {len(run.tasks)} tasks"
            yield f"{summary.label}: unfinished, {done}; {end}."


def _draw(report: Report) -> None:
    # Here, because Matplotlib takes long to import.
    from rewire_jax.reports import plots
    from rewire_jax.reports.tradeoff_plot import Point, tradeoff

    def line(summary: Summary) -> plots.Line:
        run, kept = summary.run, summary.run.kept
        scores = np.concatenate([run.before[:, None], run.scores], axis=1)
        curve = [(x, values[kept]) for x, values in run.curve]
        return plots.Line(summary.label, curve, scores[kept])

    def point(summary: Summary) -> Point:
        value = summary.performance
        mean = math.nan if value.mean is None else value.mean
        return Point(summary.label, summary.run.model_size, mean, value.std)

    comparison, title = report.comparison, report.title
    score, run = comparison.score, report.summaries[0].run
    budget = int(run.settings["interactions"])
    lines = [line(summary) for summary in report.summaries]
    plots.curves(lines, run.tasks, budget, score, title, report.curves)
    plots.matrices(lines, run.tasks, score, title, report.matrix)
    points = [point(summary) for summary in report.summaries]
    tradeoff(points, comparison.unit, title, report.tradeoff)


def _markdown(report: Report) -> str:
    comparison = report.comparison
    lines = [f"# {report.title}", ""]
    for note in report.notes:
        lines += [f"**{note}**", ""]
    results, costs = run_tables.results(comparison), run_tables.costs(comparison)
    lines += run_tables.markdown(
        results.heads + costs.heads[1:],
        [row + more[1:] for row, more in zip(results.rows, costs.rows, strict=True)],
    )
    for note in _reading(comparison):
        lines += [note, ""]
    for name, path in (
        ("Performance and model size", report.tradeoff),
        ("Learning curves", report.curves),
        ("Matrix", report.matrix),
    ):
        lines += [f"![{name}]({path.name})", ""]
    lines += run_tables.markdown(*run_tables.tasks(comparison))
    lines += [_origin(summary.label, summary.run) for summary in report.summaries]
    lines += [_origin(f"{run.tasks[0]} alone", run) for run in comparison.single]
    return "\n".join(lines) + "\n"


def _origin(label: str, run: RunData) -> str:
    seeds = ", ".join(str(seed) for seed in run.seeds)
    facts = [
        f"{key} `{run.provenance.get(key)}`" for key in ("command", "commit", "started")
    ]
    return f"- {label}: `{run.folder}`, seeds {seeds}, {', '.join(facts)}"


def _json(report: Report) -> str:
    runs = [
        {
            "label": summary.label,
            "method": summary.run.settings["method"],
            "folder": str(summary.run.folder),
            "budget": summary.run.settings["interactions"],
            "complete": summary.run.complete,
            "finished_tasks": summary.run.finished,
            "all_seeds": summary.run.seeds,
            "diverged": summary.run.diverged,
            # The seeds whose `values` stand below, in their order.
            "kept": np.array(summary.run.seeds)[summary.run.kept].tolist(),
            "tasks": _tasks_json(summary.run, summary.tasks),
            "scores": summary.run.scores[summary.run.kept].tolist(),
            **_others_json(summary),
            "performance": asdict(summary.performance),
            "iqm": asdict(summary.iqm),
            "mean_forgetting": asdict(summary.forgetting),
            "forward_transfer": asdict(summary.transfer),
            **run_tables.run_values(summary),
            "published": [
                theirs
                and {"table": source.table, "of": source.name, **theirs._asdict()}
                for source, theirs in zip(
                    report.comparison.sources, summary.published, strict=True
                )
            ],
            "settings": summary.run.settings,
            "provenance": summary.run.provenance,
        }
        for summary in report.summaries
    ]
    data = {
        "format": 2,
        "title": report.title,
        "notes": report.notes,
        "unit": report.comparison.unit,
        "runs": runs,
    }
    if report.comparison.single:
        data["single"] = [
            {
                "task": run.tasks[0],
                "folder": str(run.folder),
                "seeds": run.seeds,
                "settings": run.settings,
                "provenance": run.provenance,
            }
            for run in report.comparison.single
        ]
    return run_tables.json_text(data)


def _tasks_json(run: RunData, tasks: Tasks) -> list[dict[str, Any]]:
    return [
        {"name": name, **{key: asdict(value) for key, value in task.items()}}
        for name, task in zip(run.tasks, tasks, strict=True)
    ]


def _others_json(summary: Summary) -> dict[str, Any]:
    """Scores that were measured beside the one of the report."""
    run = summary.run
    others = {
        score.name: {
            "tasks": _tasks_json(run, summary.others[score.name]),
            "scores": values[run.kept, 1:].tolist(),
        }
        for score, values in run.measured.items()
        if score != run.score
    }
    return {"others": others} if others else {}
