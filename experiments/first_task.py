"""What the pictures of training share: curves of runs on their first task."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments import suite
from rewire_jax.config import require
from rewire_jax.evolution import Curve, evolution
from rewire_jax.numerals import number
from rewire_jax.report import heading
from rewire_jax.rundata import read_progress, read_run

READING = (
    "Over seeds; those that diverged have no part in it. The end is the last tenth of "
    "the progress reports."
)


@dataclass(frozen=True, kw_only=True)
class FirstTask(suite.Experiment):
    """What to run.

    Attributes:
      scenario: name of the scenario.
      tasks: of the sequence that are trained; only the first is shown.
    """

    scenario: str = "halfcheetah/forgetting"
    tasks: int = 1


class Evolution(NamedTuple):
    """What the progress reports of runs tell.

    Attributes:
      title: what was run, and with what budget.
      curves: by the name of the run, in the order of the labels.
      origins: Markdown, where the runs come from.
    """

    title: str
    curves: dict[str, Curve]
    origins: list[str]


def read(
    subject: str,
    runs: Sequence[suite.Run],
    labels: Mapping[str, str],
    value: str | None = None,
) -> Evolution:
    """Reads what was reported during the first task.

    Args:
      subject: what the title begins with.
      runs: that have results.
      labels: by the name of the run.
      value: name of what to read; by default it is the training return.

    Raises:
      UserError: there is nothing to show yet.
    """
    curves, origins = {}, []
    for run in runs:
        name, data = run.folder.name, read_run(run.folder)
        x, values = (read_progress(data, value) if value else data.curve)[0]
        if x.size and data.kept.any():
            curves[name] = Curve(labels[name], x, values[data.kept])
            origins.append(f"- {suite.origin(labels[name], data)}")
    require(bool(curves), "none of the runs has reported on a seed without divergence")
    seeds = f"{len(data.seeds)} seed{'' if len(data.seeds) == 1 else 's'}"
    subject = f"{subject} on the first task of {data.settings['scenario']}"
    title = heading(subject, data.settings, len(data.tasks), seeds)
    curves = {name: curves[name] for name in labels if name in curves}
    return Evolution(title, curves, origins)


def write(
    path: Path,
    quantity: str,
    found: Evolution,
    panels: Sequence[Sequence[str]],
    notes: Sequence[str] = (),
    *,
    log: bool = False,
) -> None:
    """Writes a table of curves, their numbers and their picture.

    Args:
      path: of the files, without a suffix.
      quantity: what the values are.
      found: what is shown.
      panels: of the picture, names of the runs in each.
      notes: lines of Markdown above how to read the table.
      log: whether the picture's values are.
    """
    title, curves, origins = found
    picture = path.with_suffix(".png")
    shown = (f"![{title}]({picture.name})", "", *notes, READING, "", *origins)
    table = summary(list(curves.values()), quantity)
    suite.write(path, title, table, shown, rows(curves))
    drawn = [[curves[name] for name in panel if name in curves] for panel in panels]
    evolution(drawn, quantity, title, picture, log=log)
    print(picture)


def tenth(curve: Curve) -> int:
    """How many reports make a tenth."""
    return max(curve.x.size // 10, 1)


def summary(curves: Sequence[Curve], quantity: str) -> list[list[str]]:
    """A table of the end of each curve and of its mean over all of training."""
    head = [quantity, "median at the end", "mean", "95% interval", "mean of all"]
    table = [head]
    for curve in curves:
        last = curve.values[:, -tenth(curve) :].mean(axis=1, keepdims=True)
        end = Curve(curve.label, curve.x[-1:], last)
        shown = [*end.median, *end.mean, *end.interval[:, 0], np.nanmean(curve.values)]
        median, mean, low, high, whole = map(number, shown)
        table.append([curve.label, median, mean, f"{low} to {high}", whole])
    return table


def rows(curves: Mapping[str, Curve]) -> list[dict[str, Any]]:
    """The numbers, a row for each run and progress report."""
    return [
        {"run": name, "seeds": len(curve.values), "interactions": int(x)}
        | dict(zip(("median", "mean", "low", "high"), values, strict=True))
        for name, curve in curves.items()
        for x, *values in zip(
            curve.x, curve.median, curve.mean, *curve.interval, strict=True
        )
    ]
