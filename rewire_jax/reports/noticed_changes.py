"""When runs with `--boundaries detected` noticed that the task had changed."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.formatting import number
from rewire_jax.reports.run_summary import Comparison
from rewire_jax.reports.table import Table
from rewire_jax.storage.run_results import RunData

READING = (
    "Noticed changes are those after which the learner started a new task. The first "
    "one in a task counts as the change to this task, others count as false alarms. "
    "The delay is the mean over the seeds that noticed the change, in interactions."
)


@dataclass(frozen=True)
class Noticed:
    """What the seeds of a run noticed in a task.

    Attributes:
        delays: `[kept seeds]`, interactions from the change to this task until it was
            noticed; NaN if it was not, and in the first task.
        false_alarms: `[kept seeds]` int, other changes that were noticed.
    """

    delays: NDArray[np.float64]
    false_alarms: NDArray[np.int_]


def noticed(run: RunData) -> tuple[Noticed, ...]:
    """What a run noticed in each task that it began; empty if it was told the tasks."""
    found = []
    before = np.zeros(run.kept.sum())
    for task, (interactions, values) in enumerate(run.segments):
        segments = values[run.kept]
        if not interactions.size:
            break
        new = segments - before[:, None] > 0
        first = interactions[new.argmax(axis=1)]
        seen = new.any(axis=1) & (task > 0)
        known = np.column_stack([before, segments])  # `before` alone may be known
        rises = np.nanmax(known, axis=1) - before
        found.append(Noticed(np.where(seen, first, np.nan), (rises - seen).astype(int)))
        before = before + rises
    return tuple(found)


def table(comparison: Comparison) -> Table:
    """A row for each task of each run that was not told the tasks."""
    rows = []
    for summary in comparison.summaries:
        run = summary.run
        for place, at in enumerate(noticed(run)):
            seen = at.delays[~np.isnan(at.delays)]
            of = f"{seen.size} of {run.kept.sum()}"
            rows.append(
                [
                    summary.label,
                    f"{place + 1} {run.tasks[place]}",
                    of if place else "–",
                    number(float(seen.mean())) if seen.size else "–",
                    str(at.false_alarms.sum()),
                ]
            )
    heads = "method", "task", "seeds that noticed it", "delay", "false alarms"
    return Table(heads, rows)


def to_json(run: RunData) -> dict[str, Any]:
    """The same of a run, for each task and seed; empty if it was told the tasks."""
    tasks = [
        {
            "delays": [None if np.isnan(x) else x for x in at.delays.tolist()],
            "false_alarms": at.false_alarms.tolist(),
        }
        for at in noticed(run)
    ]
    return {"noticed_changes": tasks} if tasks else {}
