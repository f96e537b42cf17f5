"""Shared code of the plots of training: learning curves on the first task.

Each seed is a separate run. A script trains the runs one after the other. Or it shows
those of a campaign, which trains several side by side and keeps them (`--campaign`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments import suite
from rewire_jax.core.arguments import require
from rewire_jax.core.formatting import number
from rewire_jax.reports.campaign_data import read_campaign_data
from rewire_jax.reports.plots import Array
from rewire_jax.reports.provenance import origin
from rewire_jax.reports.titles import heading
from rewire_jax.reports.training_curve_plot import Curve, evolution
from rewire_jax.storage.merged_results import merged_curve
from rewire_jax.storage.run_results import RunData, read_progress

READING = (
    "Values are over seeds. Diverged seeds and unfinished runs are left out. The end "
    "is the last whole episode: all environments start their episodes together, so "
    "each part of an episode counts once."
)
_EPISODES = 128
_REPORT, _CHECKPOINT = 12_800, 100_000


@dataclass(frozen=True, kw_only=True)
class FirstTask(suite.OfCampaign):
    """What to run.

    Attributes:
      scenario: name of the scenario.
      tasks: number of tasks to train; only the first task is shown.
    """

    scenario: str = "halfcheetah/forgetting"
    tasks: int = 1

    def first_runs(self, variants: suite.Variants) -> list[suite.Run]:
        """A run for each seed and variant, one seed after the other.

        Reports and checkpoints are as dense as a curve needs. What the policy earns in
        the end is told by 128 episodes at most.
        """
        runs = []
        for seed in range(self.seed, self.seed + self.seeds):
            one = replace(self, seed=seed, seeds=1)
            parent = self.out / self.name(f"{self.scenario}-first-task")
            for run in one.runs(self.scenario, variants):
                given = run.settings
                settings = replace(
                    given,
                    eval_episodes=min(given.eval_episodes, _EPISODES),
                    selection_episodes=min(given.selection_episodes, 32),
                    report_every=min(given.report_every, _REPORT),
                    checkpoint_every=min(given.checkpoint_every, _CHECKPOINT),
                )
                folder = parent / run.folder.name / f"seed-{seed}"
                runs.append(run._replace(folder=folder, settings=settings))
        return runs


class Trained(NamedTuple):
    """Results of the runs of a variant.

    Attributes:
      curve: `[seeds, points]`, the values reported in training.
      seeds: the seeds.
      returns: `[seeds]`, returns after the task, without exploration.
      episode: interactions that all environments need for one episode.
    """

    curve: Curve
    seeds: tuple[int, ...]
    returns: Array
    episode: float

    def over_episode(self, at: int) -> Array:
        """`[seeds]`, the mean over the episode that ends with a report.

        A report counts by how much of its time lies in the episode; before a whole
        one has been played, all do.
        """
        x, values = self.curve.x[: at + 1], self.curve.values[:, : at + 1]
        took = np.diff(x, prepend=0.0)
        weight = np.clip(
            took - np.maximum(x[-1] - self.episode - (x - took), 0), 0, None
        )
        return values[:, weight > 0] @ (weight[weight > 0] / weight.sum())

    @property
    def end(self) -> Array:
        """`[seeds]`, the mean over the last episode."""
        return self.over_episode(self.curve.x.size - 1)


class Evolution(NamedTuple):
    """Learning curves from the progress reports of runs.

    Attributes:
      title: what was run, and with what budget.
      found: by variant, in the order of the labels.
      origins: Markdown, where the runs come from, and which are not finished.
    """

    title: str
    found: dict[str, Trained]
    origins: list[str]


def train(
    job: FirstTask,
    subject: str,
    variants: suite.Variants,
    labels: Mapping[str, str],
    value: str | None = None,
) -> Evolution:
    """Trains what is unfinished, and reads it.

    Raises:
      UserError: as `suite.train`, `read_campaign_data` and `read` do.
    """
    if job.campaign is not None:
        data = read_campaign_data(job.campaign, job.trained_in)
        runs = {
            each.folder: data.finished.get(each.run.name)
            for each in data.jobs
            if each.run.settings.scenario == job.scenario
        }
    else:
        planned = job.first_runs(variants)
        suite.train(planned, job)
        runs = {run.folder: run.result for run in planned}
    return read(subject, runs, labels, value)


def read(
    subject: str,
    runs: Mapping[Path, RunData | None],
    labels: Mapping[str, str],
    value: str | None = None,
) -> Evolution:
    """Reads what was reported during the first task.

    Args:
      subject: what the title begins with.
      runs: by their folders, which are in folders of their variants; None for one that
        is not finished.
      labels: by variant.
      value: name of what to read; by default it is the training return.

    Raises:
      UserError: there is nothing to show yet.
    """
    runs = {path: run for path, run in runs.items() if path.parent.name in labels}
    require(bool(runs), f"there are no runs named {', '.join(labels)}")
    require(any(runs.values()), "none of the runs is finished yet")
    found, origins, settings, tasks = {}, [], {}, 1
    for name, label in labels.items():
        datas = [run for path, run in runs.items() if run and path.parent.name == name]
        kept = [data for data in datas if data.kept.any()]
        if kept:
            found[name] = gather(label, kept, value)
            settings, tasks = kept[0].settings, len(kept[0].tasks)
        if datas:
            origins.append(origin(label, *datas))
    require(bool(found), "none of the runs has ended without divergence")
    missing = [str(path) for path, run in runs.items() if not run]
    if missing:
        origins.append(f"- **not finished: {', '.join(missing)}**")
    seeds = [len(trained.seeds) for trained in found.values()]
    subject = f"{subject} on the first task of {settings['scenario']}"
    return Evolution(heading(subject, settings, tasks, seeds), found, origins)


def gather(label: str, kept: Sequence[RunData], value: str | None = None) -> Trained:
    """Runs of one variant as one, without their diverged seeds."""
    parts = []
    for run in kept:
        x, values = (read_progress(run, value) if value else run.curve)[0]
        parts.append((x, values[run.kept]))
    return Trained(
        Curve(label, *merged_curve(parts)),
        tuple(int(s) for run in kept for s in np.array(run.seeds)[run.kept]),
        np.concatenate([run.scores[run.kept, 0, 0] for run in kept]),
        kept[0].episode_length * float(kept[0].settings["envs"]),
    )


def write(
    path: Path,
    quantity: str,
    evolved: Evolution,
    panels: Sequence[Sequence[str]],
    notes: Sequence[str] = (),
    *,
    table: Sequence[Sequence[str]] | None = None,
    log: bool = False,
) -> None:
    """Writes a table of curves, their numbers and their picture.

    Args:
      path: of the files, without a suffix.
      quantity: what the values are.
      evolved: what is shown.
      panels: of the picture, variants in each.
      notes: lines of Markdown above how to read the table.
      table: for people; by default that of `summary`.
      log: whether the picture's values are.
    """
    title, found, origins = evolved
    picture = path.with_suffix(".png")
    shown = (f"![{title}]({picture.name})", "", *notes, READING, "", *origins)
    table = table or summary(list(found.values()), quantity)
    suite.write(path, title, table, shown, rows(found))
    drawn = [[found[name].curve for name in panel if name in found] for panel in panels]
    evolution([panel for panel in drawn if panel], quantity, title, picture, log=log)
    print(picture)


def tenth(curve: Curve) -> int:
    """How many reports make a tenth."""
    return max(curve.x.size // 10, 1)


def summary(found: Sequence[Trained], quantity: str) -> list[list[str]]:
    """A table of the end of each curve and of its mean over all of training."""
    table = [[quantity, "median at the end", "mean", "95% interval", "mean of all"]]
    for trained in found:
        whole = float(np.nanmean(trained.curve.values))
        table.append([trained.curve.label, *ends(trained), number(whole)])
    return table


def ends(trained: Trained) -> list[str]:
    """Median, mean and interval of the mean at the end."""
    end = Curve("", trained.curve.x[-1:], trained.end[:, None])
    low, high = map(number, end.interval[:, 0])
    return [number(end.median[0]), number(end.mean[0]), f"{low} to {high}"]


def rows(found: Mapping[str, Trained]) -> list[dict[str, Any]]:
    """The numbers, a row for each run and progress report.

    The return without exploration stands in a run's last row.
    """
    return [
        {
            "run": name,
            "seed": seed,
            "interactions": int(x),
            "value": float(at),
            "deterministic": float(after) if x == trained.curve.x[-1] else None,
        }
        for name, trained in found.items()
        for seed, values, after in zip(
            trained.seeds, trained.curve.values, trained.returns, strict=True
        )
        for x, at in zip(trained.curve.x, values, strict=True)
    ]
