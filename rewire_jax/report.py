"""Tables, pictures and a result file of one or more runs, from their files alone."""

import io
import json
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

from rewire_jax import figures, tables
from rewire_jax.errors import UserError
from rewire_jax.rundata import RunData, read_run
from rewire_jax.summary import MEASURES, Summary, summarize

__all__ = ["Report", "RunData", "read_run", "to_terminal", "write_report"]

_READING = (
    "Returns are deterministic evaluations: mean ± sample standard deviation over "
    "seeds. Forgetting is the return at the end minus the return right after own "
    "training: negative means forgotten. Performance is the return at the end averaged "
    "over tasks. Interactions (training, selection) are for each seed; interactions/s "
    "is training in all seeds together, without chunks that compiled."
)


@dataclass(frozen=True)
class Report:
    """What was written, and the numbers in it.

    Attributes:
        title: scenario, profile, budget, backend, seeds.
        notes: what a reader must know: diverged seeds, unfinished runs.
        summaries: the numbers, one entry for each run.
        markdown: the tables for people.
        csv: the same numbers, one a row.
        json: the numbers by seed, with every run's settings and provenance.
        curves: picture of training over the sequence.
        matrix: picture of task × stage.
    """

    title: str
    notes: tuple[str, ...]
    summaries: tuple[Summary, ...]
    markdown: Path
    csv: Path
    json: Path
    curves: Path
    matrix: Path

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of the report."""
        return self.markdown, self.csv, self.json, self.curves, self.matrix


def write_report(runs: Sequence[str | Path], out: str | Path) -> Report:
    """Writes the report of comparable runs.

    Args:
        runs: run folders, complete or partial.
        out: the folder to write into; made where missing, an old report is replaced.

    Raises:
        UserError: a run cannot be read, the runs are not comparable, or `out` cannot
            be written.
    """
    summaries = summarize([read_run(run) for run in runs])
    out = Path(out)
    report = Report(
        title=_title(summaries),
        notes=tuple(_notes(summaries)),
        summaries=summaries,
        markdown=out / "report.md",
        csv=out / "report.csv",
        json=out / "result.json",
        curves=out / "curves.png",
        matrix=out / "matrix.png",
    )
    first = summaries[0].run
    lines = [_line(summary) for summary in summaries]
    budget = int(first.settings["interactions"])
    try:
        out.mkdir(parents=True, exist_ok=True)
        report.markdown.write_text(_markdown(report), encoding="utf-8")
        report.csv.write_text(tables.csv_text(summaries), encoding="utf-8")
        report.json.write_text(_json(report), encoding="utf-8")
        figures.curves(lines, first.tasks, budget, report.title, report.curves)
        figures.matrices(lines, first.tasks, report.title, report.matrix)
    except OSError as error:
        raise UserError(f"cannot write {error.filename}: {error.strerror}") from None
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
    for heads, rows in _tables(report.summaries):
        table = Table(
            box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True
        )
        for k, head in enumerate(heads):
            if head in tables.WORDS:
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
    for note in (_READING, *report.notes):
        console.print(Text(note))
    console.print()
    for path in report.paths:
        # A path that is wrapped cannot be copied.
        console.print(Text(str(path)), soft_wrap=True)
    return file.getvalue()


def _tables(
    summaries: Sequence[Summary],
) -> tuple[tuple[tuple[str, ...], list[list[str]]], ...]:
    """Headings and rows, the tasks first: a terminal shows the end best."""
    return (
        (tables.TASK_HEADS, tables.task_rows(summaries)),
        (tables.OVERALL_HEADS, tables.overall_rows(summaries)),
    )


def _title(summaries: Sequence[Summary]) -> str:
    settings = summaries[0].run.settings
    budget, paper = int(settings["interactions"]), settings.get("paper_interactions")
    counts = sorted({len(summary.run.seeds) for summary in summaries})
    seeds = " to ".join(str(count) for count in sorted({counts[0], counts[-1]}))
    parts = [
        f"{settings['scenario']}: {settings['profile']} profile",
        f"{budget:,} interactions a task",
        f"{settings['backend']} backend",
        f"{seeds} seed{'' if counts[-1] == 1 else 's'}",
    ]
    if paper is not None and budget < int(paper):
        parts.append(f"reduced budget (paper: {int(paper):,})")
    elif paper is None and settings["profile"] != "paper":
        parts.append("reduced budget")
    return ", ".join(parts)


def _notes(summaries: Sequence[Summary]) -> Iterator[str]:
    for summary in summaries:
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


def _line(summary: Summary) -> figures.Line:
    run, kept = summary.run, summary.run.kept
    scores = np.concatenate([run.before[:, None], run.scores], axis=1)
    curve = [(x, returns[kept]) for x, returns in run.curve]
    return figures.Line(summary.label, curve, scores[kept])


def _markdown(report: Report) -> str:
    lines = [f"# {report.title}", "", _READING, ""]
    for note in report.notes:
        lines += [f"**{note}**", ""]
    for heads, rows in _tables(report.summaries):
        rule = ["---" if head in tables.WORDS else "---:" for head in heads]
        lines += [f"| {' | '.join(row)} |" for row in (heads, rule, *rows)]
        lines.append("")
    for name, path in (("Learning curves", report.curves), ("Matrix", report.matrix)):
        lines += [f"![{name}]({path.name})", ""]
    for summary in report.summaries:
        run, made = summary.run, summary.run.provenance
        seeds = ", ".join(str(seed) for seed in run.seeds)
        facts = [f"{key} `{made.get(key)}`" for key in ("command", "commit", "started")]
        lines.append(
            f"- {summary.label}: `{run.folder}`, seeds {seeds}, {', '.join(facts)}"
        )
    return "\n".join(lines) + "\n"


def _json(report: Report) -> str:
    runs = [
        {
            "label": summary.label,
            "method": summary.run.settings["method"],
            "folder": str(summary.run.folder),
            "budget": summary.run.settings["interactions"],
            "complete": summary.run.complete,
            "finished_tasks": summary.run.finished,
            "seeds": summary.run.seeds,
            "diverged": summary.run.diverged,
            # The seeds whose `values` stand below, in their order.
            "kept": np.array(summary.run.seeds)[summary.run.kept].tolist(),
            "tasks": [
                {"name": name, **{key: asdict(value) for key, value in task.items()}}
                for name, task in zip(summary.run.tasks, summary.tasks, strict=True)
            ],
            "performance": asdict(summary.performance),
            "mean_forgetting": asdict(summary.forgetting),
            **tables.run_values(summary.run),
            "settings": summary.run.settings,
            "provenance": summary.run.provenance,
        }
        for summary in report.summaries
    ]
    data = {"format": 1, "title": report.title, "notes": report.notes, "runs": runs}
    return json.dumps(_without_nan(data), indent=1, allow_nan=False) + "\n"


def _without_nan(data: Any) -> Any:
    """JSON has no NaN: null stands for it."""
    if isinstance(data, dict):
        return {key: _without_nan(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_without_nan(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
