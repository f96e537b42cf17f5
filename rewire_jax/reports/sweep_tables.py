"""A sweep's numbers as rows of text, for Markdown and CSV."""

from typing import Any

import numpy as np

from rewire_jax.core.formatting import short
from rewire_jax.reports.data_files import csv_text
from rewire_jax.reports.spread import spread
from rewire_jax.reports.sweep_summary import (
    Configuration,
    Panel,
    SweepSummary,
    performance,
)
from rewire_jax.reports.table import Table

UNIT = "raw return"
_SHOWN = 10  # configurations in a table for people


def settings_text(values: dict[str, float]) -> str:
    """Values by axis in words."""
    return ", ".join(f"{name} {short(value)}" for name, value in values.items())


def ranking(summary: SweepSummary) -> Table:
    """The best configurations."""
    rows = [
        [
            str(place),
            *_cells(each),
            str(each.performance),
            str(each.interval),
            str(each.choice),
            f"{len(each.kept)} of {len(each.members)}",
            str(each.stage),
        ]
        for place, each in enumerate(summary.configurations[:_SHOWN], 1)
    ]
    heads = (
        "rank",
        *summary.sweep.axes,
        f"performance ({UNIT})",
        "mean [95% interval]",
        "performance in the ranking episodes",
        "seeds",
        "tasks",
    )
    return Table(heads, rows)


def values(summary: SweepSummary, panel: Panel) -> Table:
    """A row for each value of an axis; thirds of the values where they were drawn."""
    order, axis = summary.configurations, panel.axis
    places = sorted({each.values[axis] for each in order})
    bins = [[value] for value in places]
    if summary.sweep.random:
        parts = np.array_split(places, min(3, len(places)))
        bins = [part.tolist() for part in parts]
    rows = []
    for part in bins:
        there = [each for each in order if each.values[axis] in part]
        level = [each for each in there if each.stage == summary.stage]
        means = [each.performance.mean for each in level]
        over = spread(np.array([m for m in means if m is not None], np.float64))
        ends = [short(x) for x in sorted({part[0], part[-1]})]
        row = [" to ".join(ends), f"{len(level)} of {len(there)}"]
        row += [str(over)]
        row += [str(level[0].performance) if level else "–"]
        if not summary.sweep.random:
            alone = [e for e in panel.line if e.values[axis] in part and e in level]
            row += [str(alone[0].performance) if alone else "–"]
        rows.append(row)
    heads = [axis, "configurations", "mean over these", "the best of these"]
    if not summary.sweep.random:
        heads.append(f"with {settings_text(panel.others) or 'this alone'}")
    return Table(tuple(heads), rows)


def lost(summary: SweepSummary) -> Table:
    """The configurations of which a seed diverged."""
    rows = [
        [*_cells(each), ", ".join(map(str, each.diverged)), str(each.stage)]
        for each in summary.configurations
        if each.diverged
    ]
    return Table((*summary.sweep.axes, "diverged seeds", "tasks"), rows)


def configurations_csv(summary: SweepSummary) -> str:
    """A row for each configuration, the best first."""
    return csv_text([_row(each) for each in summary.configurations])


def members_csv(summary: SweepSummary) -> str:
    """A row for each member and stage it was evaluated after; stages count from 1."""
    sweep = summary.sweep
    reported, chosen = performance(sweep.scores), performance(sweep.choice)
    rows = [
        {
            "member": int(member),
            "configuration": int(sweep.configurations[member]),
            "seed": int(sweep.seeds[member]),
        }
        | {name: float(axis[member]) for name, axis in sweep.axes.items()}
        | {
            "stage": int(stage) + 1,
            "task": sweep.tasks[stage],
            "performance": float(reported[member, stage]),
            "choice": float(chosen[member, stage]),
            "return": float(sweep.scores[member, stage, stage]),
            "diverged": bool(sweep.diverged[member, stage]),
            "model_size": float(sweep.model_size[member, stage]),
            "training_interactions": int(sweep.training[member, stage]),
            "selection_interactions": int(sweep.selection[member, stage]),
            "stopped": bool(sweep.stopped[member, stage]),
        }
        for member, stage in np.argwhere(sweep.evaluated)
    ]
    return csv_text(rows)


def _row(each: Configuration) -> dict[str, Any]:
    """A configuration's columns."""
    return (
        {"configuration": each.index}
        | each.values
        | {
            "stage": each.stage,
            "stopped": each.stopped,
            "seeds": len(each.kept),
            "diverged": len(each.diverged),
        }
        | each.performance.columns("performance")
        | each.interval.columns("performance")
        | each.choice.columns("choice")
    )


def _cells(each: Configuration) -> list[str]:
    return [short(value) for value in each.values.values()]
