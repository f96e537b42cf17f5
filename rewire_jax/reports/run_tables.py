"""A report's numbers as rows of text, for Markdown, terminal and CSV."""

import csv
import io
import json
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from rewire_jax.core.formatting import number
from rewire_jax.reports.paper_results import Figures
from rewire_jax.reports.run_summary import Comparison, Interval, Spread, Summary

# Columns of words are set to the left, all others to the right.
WORDS = frozenset(("method", "task", "seeds", "device", "fault"))


class Table(NamedTuple):
    """Headings, and rows as long; the first column names the run."""

    heads: tuple[str, ...]
    rows: list[list[str]]


def tasks(comparison: Comparison) -> Table:
    """A row for each run and task, not normalised; tasks count from 1."""
    measures = comparison.measures
    rows = [
        [summary.label, f"{k} {name}", *(spread(task[measure]) for measure in measures)]
        for summary in comparison.summaries
        for k, (name, task) in enumerate(
            zip(summary.run.tasks, summary.tasks, strict=True), 1
        )
    ]
    return Table(("method", "task", *measures.values()), rows)


def results(comparison: Comparison) -> Table:
    """A row for each run in the form of the paper's Table 1, the paper's beside it."""
    heads = [
        "method",
        f"performance ({comparison.unit})",
        "IQM [95% interval]",
        "model size",
    ]
    for source in comparison.sources:
        heads.append(f"paper's {source.table}, {source.name} ({source.unit})")
        if source.sized:
            heads.append("its model size")
    rows = []
    for summary in comparison.summaries:
        row = [
            summary.label,
            spread(summary.performance),
            interval(summary.iqm),
            f"{summary.run.model_size:.2f}",
        ]
        for source, theirs in zip(comparison.sources, summary.published, strict=True):
            row.append(f"{theirs.mean:.2f} ± {theirs.std:.2f}" if theirs else "–")
            if source.sized:
                row.append(f"{theirs.size:.1f}" if theirs and theirs.size else "–")
        rows.append(row)
    return Table(tuple(heads), rows)


def costs(comparison: Comparison) -> Table:
    """A row for each run: what was forgotten, what was of use, what it took."""
    transferred = comparison.transferred
    rows = [
        [
            summary.label,
            spread(summary.forgetting),
            *([spread(summary.transfer)] if transferred else []),
            f"{summary.run.training:,}",
            f"{summary.run.selection:,}",
            number(summary.run.hours),
            _memory(summary),
            _seeds(summary),
            str(summary.run.provenance.get("device", "–")),
        ]
        for summary in comparison.summaries
    ]
    heads = (
        "method",
        "forgetting",
        *(["forward transfer"] if transferred else []),
        "training",
        "selection",
        "hours, all seeds together",
        "most memory held",
        "seeds",
        "device",
    )
    return Table(heads, rows)


def results_csv(comparison: Comparison) -> str:
    """CSV with a row a run and a column a number."""
    return csv_text(
        [
            {"method": summary.label, "unit": comparison.unit}
            | columns("performance", summary.performance)
            | {
                "iqm": summary.iqm.value,
                "iqm_low": summary.iqm.low,
                "iqm_high": summary.iqm.high,
            }
            | columns("forgetting", summary.forgetting)
            | (
                columns("forward_transfer", summary.transfer)
                if comparison.transferred
                else {}
            )
            | run_values(summary)
            | {
                f"paper_{source.key}_{key}": getattr(theirs, key, None)
                for source, theirs in zip(
                    comparison.sources, summary.published, strict=True
                )
                for key in Figures._fields
                if key != "size" or source.sized
            }
            for summary in comparison.summaries
        ]
    )


def tasks_csv(comparison: Comparison) -> str:
    """CSV with a row for each run and task, not normalised; tasks count from 1.

    Where several scores were measured, a column says which is the one without a prefix.
    """
    rows = []
    for summary in comparison.summaries:
        for k, name in enumerate(summary.run.tasks):
            row = {"method": summary.label, "task": k + 1, "name": name}
            if summary.others:
                row["score"] = comparison.score.name
            for prefix, tasks in {"": summary.tasks, **summary.others}.items():
                for measure, value in tasks[k].items():
                    column = f"{prefix}_{measure}" if prefix else measure
                    row |= columns(column, value)
            rows.append(row)
    return csv_text(rows)


def run_values(summary: Summary) -> dict[str, Any]:
    """The values that a run has once and not for each seed."""
    run = summary.run
    return {
        "model_size": run.model_size,
        "training_interactions": run.training,
        "selection_interactions": run.selection,
        "hours_all_seeds": run.hours,
        "interactions_per_second": run.rate,
        "peak_memory_bytes": sum(run.memory.values()) or None,
        "peak_memory_of": next(iter(run.memory), None),
        "seeds": int(run.kept.sum()),
        "diverged_seeds": len(run.diverged),
        "device": run.provenance.get("device"),
    }


def csv_text(rows: Sequence[dict[str, Any]]) -> str:
    """CSV of rows that all have the same columns; None and NaN are left empty."""
    file = io.StringIO()
    writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(_without_nan(rows))
    return file.getvalue()


def json_text(data: Any) -> str:
    """JSON, with null for what is not finite."""
    return json.dumps(_without_nan(data), indent=1, allow_nan=False) + "\n"


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table in Markdown, the last one empty."""
    rule = ["---" if head in WORDS else "---:" for head in heads]
    return [*(f"| {' | '.join(row)} |" for row in (heads, rule, *rows)), ""]


def columns(name: str, value: Spread) -> dict[str, Any]:
    """Mean and standard deviation as columns of a CSV."""
    return {f"{name}_mean": value.mean, f"{name}_std": value.std}


def spread(value: Spread) -> str:
    """Mean ± standard deviation."""
    if value.mean is None or value.std is None:
        return number(value.mean)
    scale = max(abs(value.mean), value.std)
    return f"{number(value.mean, scale)} ± {number(value.std, scale)}"


def interval(value: Interval) -> str:
    """A value and the ends of its interval."""
    if value.low is None or value.high is None:
        return number(value.value)
    scale = max(abs(value.low), abs(value.high))
    ends = f"[{number(value.low, scale)}, {number(value.high, scale)}]"
    return f"{number(value.value, scale)} {ends}"


def _memory(summary: Summary) -> str:
    held = [f"{bytes / 1e9:.2f} GB ({of})" for of, bytes in summary.run.memory.items()]
    return held[0] if held else "–"


def _seeds(summary: Summary) -> str:
    run = summary.run
    count = len(run.seeds)
    return f"{run.kept.sum()} of {count}" if run.diverged else str(count)


def _without_nan(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _without_nan(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_without_nan(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
