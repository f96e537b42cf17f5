"""A report's numbers as rows of text, for Markdown, terminal and CSV."""

import csv
import io
import math
from collections.abc import Sequence

from rewire_jax.figures import number
from rewire_jax.rundata import RunData
from rewire_jax.summary import MEASURES, Spread, Summary

# Headings of `task_rows` and `overall_rows`; columns of words are set to the left.
TASK_HEADS = ("method", "task", *MEASURES.values())
OVERALL_HEADS = (
    "method",
    "seeds",
    "performance",
    "mean forgetting",
    "model size",
    "training",
    "selection",
    "interactions/s",
    "device",
)
WORDS = frozenset(("method", "task", "seeds", "device"))


def _text(value: Spread) -> str:
    if value.mean is None or value.std is None:
        return number(value.mean)
    scale = max(abs(value.mean), value.std)
    return f"{number(value.mean, scale)} ± {number(value.std, scale)}"


def task_rows(summaries: Sequence[Summary]) -> list[list[str]]:
    """A row for each run and task, under `TASK_HEADS`; tasks count from 1."""
    return [
        [summary.label, f"{k} {name}", *map(_text, task.values())]
        for summary in summaries
        for k, (name, task) in enumerate(
            zip(summary.run.tasks, summary.tasks, strict=True), 1
        )
    ]


def overall_rows(summaries: Sequence[Summary]) -> list[list[str]]:
    """A row for each run, under `OVERALL_HEADS`."""
    rows = []
    for summary in summaries:
        run = summary.run
        count = len(run.seeds)
        seeds = f"{run.kept.sum()} of {count}" if run.diverged else str(count)
        rows.append(
            [
                summary.label,
                seeds,
                _text(summary.performance),
                _text(summary.forgetting),
                f"{run.model_size:.2f}",
                f"{run.training:,}",
                f"{run.selection:,}",
                number(run.rate),
                str(run.provenance.get("device", "–")),
            ]
        )
    return rows


def csv_text(summaries: Sequence[Summary]) -> str:
    """CSV with one value a row; `task` counts from 0 and is empty for a whole run."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(("method", "task", "name", "measure", "seeds", "mean", "std"))
    for summary in summaries:
        values: list[tuple[int | str, str, str, Spread]] = [
            (k, name, measure, value)
            for k, name in enumerate(summary.run.tasks)
            for measure, value in summary.tasks[k].items()
        ]
        values.append(("", "", "performance", summary.performance))
        values.append(("", "", "mean_forgetting", summary.forgetting))
        for *cells, value in values:
            seeds = sum(not math.isnan(x) for x in value.values)
            writer.writerow((summary.label, *cells, seeds, value.mean, value.std))
        seeds = len(summary.run.seeds)
        for measure, single in run_values(summary.run).items():
            writer.writerow((summary.label, "", "", measure, seeds, single, None))
    return file.getvalue()


def run_values(run: RunData) -> dict[str, float | None]:
    """The values that a run has once and not for each seed."""
    return {
        "model_size": run.model_size,
        "training_interactions": run.training,
        "selection_interactions": run.selection,
        "interactions_per_second": run.rate,
    }
