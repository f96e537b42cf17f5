"""What the report of one or more runs has."""

import math
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rewire_jax.reports import noticed_changes, run_tables
from rewire_jax.reports.data_files import json_text
from rewire_jax.reports.provenance import origin
from rewire_jax.reports.report import Report
from rewire_jax.reports.run_summary import MEASURES, Comparison, Summary, Tasks
from rewire_jax.reports.table import Table, to_markdown
from rewire_jax.reports.titles import heading, several
from rewire_jax.storage.run_results import RunData

_READING = (
    "Performance is the score after the last task, averaged over tasks. Values are "
    "mean ± sample standard deviation over seeds. IQM is the interquartile mean of "
    "these scores over tasks and seeds, with its stratified bootstrap interval. "
    "Forgetting is a task's score at the end minus its score right after own training: "
    "negative means forgotten. Training and selection are interactions of each seed. "
    "Hours are those of training."
)
_NORMALISED = (
    "÷ SAC-N: performance, IQM, forgetting and transfer are divided by the mean return "
    "of SAC-N at the end, averaged over tasks and seeds. Forward transfer is the score "
    "right after own training minus that of SAC-N. The interval includes the spread of "
    "SAC-N: its seeds are drawn anew, too."
)
_CONTINUAL_WORLD = (
    "Performance and forgetting are Continual World's, whose forgetting has the other "
    "sign."
)
_TRANSFER = (
    "Forward transfer is Continual World's: (AUC - AUC_b) / (1 - AUC_b) for each task. "
    "AUC is the success rate of training episodes, averaged over the task's "
    "interactions: a progress report counts by the interactions since the last one, "
    "and only if episodes ended. AUC_b is the mean over seeds of the same for a run "
    "that learns the task alone. Forward transfer is undefined where AUC_b is 1."
)


def make(comparison: Comparison, folder: Path) -> Report[Comparison]:
    """The report of runs; nothing is written.

    Args:
        comparison: the numbers.
        folder: folder of the report.
    """
    title, notes = _title(comparison), tuple(_notes(comparison))
    results, costs = run_tables.results(comparison), run_tables.costs(comparison)
    tasks = task_tables(comparison)
    rows = [[*r, *c[1:]] for r, c in zip(results.rows, costs.rows, strict=True)]
    return Report(
        folder=folder,
        name="report.md",
        title=title,
        notes=notes,
        numbers=comparison,
        table=Table([*results.heads, *costs.heads[1:]], rows),
        # A terminal is too narrow for all columns side by side.
        shown=(*tasks, costs, results),
        reading=tuple(_reading(comparison)),
        texts={
            "report.csv": run_tables.results_csv(comparison),
            "tasks.csv": run_tables.tasks_csv(comparison),
            "result.json": _json(comparison, title, notes),
        },
        pictures={
            "iqm.png": "Interquartile means",
            "tradeoff.png": "Performance and model size",
            "curves.png": "Learning curves",
            "matrix.png": "Matrix",
        },
        draw=partial(_draw, comparison, title),
        details=[line for each in tasks for line in to_markdown(*each)],
        origins=[
            *(origin(each.label, each.run) for each in comparison.summaries),
            *(origin(f"{run.tasks[0]} alone", run) for run in comparison.single),
        ],
    )


def task_tables(comparison: Comparison) -> tuple[Table, ...]:
    """Tables with a row for each run and task."""
    tasks, changes = run_tables.tasks(comparison), noticed_changes.table(comparison)
    return (tasks, changes) if changes.rows else (tasks,)


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
    if any(summary.run.segments for summary in comparison.summaries):
        yield noticed_changes.READING
    for made in dict.fromkeys(source.made for source in comparison.sources):
        yield f"The paper's columns are its published results, {made}."


def _title(comparison: Comparison) -> str:
    runs = [summary.run for summary in comparison.summaries]
    first, seeds = runs[0], [len(run.seeds) for run in runs]
    return heading(first.settings["scenario"], first.settings, len(first.tasks), seeds)


def _notes(comparison: Comparison) -> Iterator[str]:
    if comparison.raw:
        yield f"Scores are raw returns, not normalised: {comparison.raw}."
    for summary in comparison.summaries:
        run = summary.run
        if run.diverged:
            lost = several(len(run.diverged), "diverged seed")
            names = ", ".join(map(str, run.diverged))
            yield f"{summary.label}: {lost} left out of means and pictures: {names}."
        if not run.complete:
            end = "there are no results after training yet"
            if run.finished:
                end = (
                    f'"{MEASURES["end"]}" is after task {run.finished}, and means are '
                    "over the tasks trained by then"
                )
            done = f"{run.finished} of {several(len(run.tasks), 'task')}"
            yield f"{summary.label}: unfinished, {done}; {end}."


def _draw(comparison: Comparison, title: str, folder: Path) -> None:
    # Here, because Matplotlib takes long to import.
    from rewire_jax.reports.interval_plot import intervals
    from rewire_jax.reports.matrix_plot import Matrix, matrices
    from rewire_jax.reports.sequence_plot import Training, curves
    from rewire_jax.reports.tradeoff_plot import Point, tradeoff

    trained, evaluated, points = [], [], []
    for summary in comparison.summaries:
        run, kept, value = summary.run, summary.run.kept, summary.performance
        stages = [(x, values[kept]) for x, values in run.curve]
        trained.append(Training(summary.label, stages))
        scores = np.concatenate([run.before[:, None], run.scores], axis=1)
        evaluated.append(Matrix(summary.label, scores[kept]))
        mean = math.nan if value.mean is None else value.mean
        points.append(Point(summary.label, run.model_size, mean, value.std))
    means = [(summary.label, summary.iqm) for summary in comparison.summaries]
    quantity = f"interquartile mean at the end ({comparison.unit})"
    score, budget = comparison.score, int(run.settings["interactions"])
    intervals(means, quantity, title, folder / "iqm.png")
    tradeoff(points, comparison.unit, title, folder / "tradeoff.png")
    curves(trained, run.tasks, budget, score, title, folder / "curves.png")
    matrices(evaluated, run.tasks, score, title, folder / "matrix.png")


def _json(comparison: Comparison, title: str, notes: tuple[str, ...]) -> str:
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
            # The seeds of the `values` below, in the same order.
            "kept": np.array(summary.run.seeds)[summary.run.kept].tolist(),
            "tasks": _tasks_json(summary.run, summary.tasks),
            "scores": summary.run.scores[summary.run.kept].tolist(),
            **_others_json(summary),
            **noticed_changes.to_json(summary.run),
            "performance": asdict(summary.performance),
            "iqm": asdict(summary.iqm),
            "mean_forgetting": asdict(summary.forgetting),
            "forward_transfer": asdict(summary.transfer),
            **run_tables.run_values(summary, comparison),
            "published": [
                theirs
                and {"table": source.table, "of": source.name, **theirs._asdict()}
                for source, theirs in zip(
                    comparison.sources, summary.published, strict=True
                )
            ],
            "settings": summary.run.settings,
            "provenance": summary.run.provenance,
        }
        for summary in comparison.summaries
    ]
    data = {
        "format": 2,
        "title": title,
        "notes": notes,
        "unit": comparison.unit,
        "runs": runs,
    }
    if comparison.single:
        data["single"] = [
            {
                "task": run.tasks[0],
                "folder": str(run.folder),
                "seeds": run.seeds,
                "settings": run.settings,
                "provenance": run.provenance,
            }
            for run in comparison.single
        ]
    return json_text(data)


def _tasks_json(run: RunData, tasks: Tasks) -> list[dict[str, Any]]:
    return [
        {"name": name, **{key: asdict(value) for key, value in task.items()}}
        for name, task in zip(run.tasks, tasks, strict=True)
    ]


def _others_json(summary: Summary) -> dict[str, Any]:
    """Scores that were measured in addition to the report's score."""
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
