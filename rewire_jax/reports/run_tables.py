"""Numbers of runs as rows of text, for Markdown, terminal and CSV."""

from typing import Any

from rewire_jax.core.formatting import number
from rewire_jax.reports.data_files import csv_text
from rewire_jax.reports.paper_results import Figures
from rewire_jax.reports.run_summary import Comparison, Summary
from rewire_jax.reports.table import Table


def tasks(comparison: Comparison) -> Table:
    """A row for each run and task, not normalised; tasks count from 1."""
    measures = comparison.measures
    rows = [
        [summary.label, f"{k} {name}", *(str(task[measure]) for measure in measures)]
        for summary in comparison.summaries
        for k, (name, task) in enumerate(
            zip(summary.run.tasks, summary.tasks, strict=True), 1
        )
    ]
    return Table(("method", "task", *measures.values()), rows)


def results(comparison: Comparison) -> Table:
    """A row for each run in the form of the paper's Table 1, next to the paper's."""
    heads = [
        "method",
        f"performance ({comparison.unit})",
        "IQM [95% interval]",
        "model size",
        *(["stored states"] if comparison.stored else []),
    ]
    for source in comparison.sources:
        heads.append(f"paper's {source.table}, {source.name} ({source.unit})")
        if source.sized:
            heads.append("model size in the paper")
    rows = []
    for summary in comparison.summaries:
        row = [
            summary.label,
            str(summary.performance),
            str(summary.iqm),
            f"{summary.run.model_size:.2f}",
            *([f"{summary.run.stored_states:.2f}"] if comparison.stored else []),
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
            str(summary.forgetting),
            *([str(summary.transfer)] if transferred else []),
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
            | summary.performance.columns("performance")
            | {"iqm": summary.iqm.value}
            | summary.iqm.columns("iqm")
            | summary.forgetting.columns("forgetting")
            | (
                summary.transfer.columns("forward_transfer")
                if comparison.transferred
                else {}
            )
            | run_values(summary, comparison)
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
                    row |= value.columns(column)
            rows.append(row)
    return csv_text(rows)


def run_values(summary: Summary, comparison: Comparison) -> dict[str, Any]:
    """The values that a run has once and not for each seed."""
    run = summary.run
    return {
        "model_size": run.model_size,
        **({"stored_states": run.stored_states} if comparison.stored else {}),
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


def _memory(summary: Summary) -> str:
    held = [f"{bytes / 1e9:.2f} GB ({of})" for of, bytes in summary.run.memory.items()]
    return held[0] if held else "–"


def _seeds(summary: Summary) -> str:
    run = summary.run
    count = len(run.seeds)
    return f"{run.kept.sum()} of {count}" if run.diverged else str(count)
