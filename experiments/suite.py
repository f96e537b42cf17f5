"""Shared code of the experiments: runs, one after the other, and files of results.

A finished run is not repeated, and a stopped run is continued. So you can repeat a
command until everything is finished. Experiments use each other's runs.
"""

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import tyro

import rewire_jax
from rewire_jax.core.arguments import require
from rewire_jax.core.errors import UserError
from rewire_jax.reports.data_files import csv_text, json_text
from rewire_jax.reports.provenance import how_made
from rewire_jax.reports.report import Report
from rewire_jax.reports.run_summary import Comparison
from rewire_jax.reports.table import to_markdown
from rewire_jax.storage.run_folder import HEADER, TABLES, compare, provenance
from rewire_jax.storage.run_results import RunData, read_run
from rewire_jax.storage.scores import Success
from rewire_jax.training.run_setup import prepare

T = TypeVar("T")
Variants = dict[str, tuple[str, dict[str, Any]]]
"""Methods and some of their options, SAC's among them, by the name of the run."""

Row = dict[str, Any]
"""The numbers of a line of a table, and what they belong to."""
Columns = Mapping[str, Callable[[Row], str]]
"""What a table shows of its rows, by heading."""

RESULTS = Path("experiments/results")
_KINDS = ("forgetting", "transfer", "robustness", "compositionality")
DOMAINS = {
    "halfcheetah": tuple(f"halfcheetah/{kind}" for kind in _KINDS),
    "ant": tuple(f"ant/{kind}" for kind in _KINDS),
    "humanoid": ("humanoid/hard",),
}


@dataclass(frozen=True, kw_only=True)
class Job:
    """How to run.

    Attributes:
      profile: "quick" or "paper".
      seeds: number of members of each run.
      seed: seed of the first member.
      interactions: training interactions for each task; 0 for the profile's value.
      tasks: number of tasks to train; 0 for the profile's value.
      backend: physics backend; by default the first backend of the domain.
      reward: version of Meta-World's rewards; ignored in other domains.
      train: train; if not, only report on existing runs, finished or not.
    """

    profile: str = "quick"
    seeds: int = 1
    seed: int = 0
    interactions: int = 0
    tasks: int = 0
    backend: str | None = None
    reward: str = "v2"
    train: bool = True

    def name(self, what: str) -> str:
        """Name of a folder for something made with this profile and budget."""
        name = f"{what.replace('/', '-')}-{self.profile}"
        name += f"-{self.interactions}" if self.interactions else ""
        return name + (f"-tasks-{self.tasks}" if self.tasks else "")

    def scenario_of(self, name: str) -> rewire_jax.Scenario:
        """A scenario with this backend and reward."""
        return rewire_jax.make_scenario(name, self.backend, self.reward)

    def run(
        self,
        scenario: rewire_jax.Scenario,
        method: str,
        folder: Path,
        sac: Mapping[str, Any] = MappingProxyType({}),
        **options: Any,
    ) -> "Run":
        """A run of the profile, with these of SAC's and of the method's options."""
        settings = rewire_jax.preset(scenario, method, self.profile)
        settings = replace(
            settings,
            seeds=self.seeds,
            seed=self.seed,
            interactions=self.interactions or settings.interactions,
            tasks=self.tasks or settings.tasks,
            sac=replace(settings.sac, **sac),
            options=replace(settings.options, **options),
        )
        return Run(folder, scenario, settings)


@dataclass(frozen=True, kw_only=True)
class Experiment(Job):
    """How to run, and where.

    Attributes:
      out: folder of all runs, with a folder for each scenario, and of the results.
      keep: write the result to experiments/results instead, to be committed.
    """

    out: Path = Path("runs")
    keep: bool = False

    def folder(self, what: str) -> Path:
        """The folder of a result."""
        return (RESULTS if self.keep else self.out) / self.name(what)

    def runs(self, scenario: str, variants: Variants) -> list["Run"]:
        """The runs on one scenario."""
        made = self.scenario_of(scenario)
        folder = self.out / self.name(scenario)
        return [
            self.run(made, method, folder / name, **options)
            for name, (method, options) in variants.items()
        ]


@dataclass(frozen=True, kw_only=True)
class OfCampaign(Experiment):
    """How to run, or which runs of a campaign to show instead.

    Attributes:
      campaign: TOML file of a campaign whose configurations have the names of the
        experiment's runs; its runs are shown, and nothing is trained.
      trained_in: folder of the campaign; by default runs/ and the name of the file.
    """

    campaign: Path | None = None
    trained_in: Path | None = None

    def name(self, what: str) -> str:
        """Name of a folder for something made with this budget, or of the campaign."""
        if self.campaign is None:
            return super().name(what)
        return f"{what}-{self.campaign.stem}"


class Run(NamedTuple):
    """A run of an experiment: its folder, scenario and settings."""

    folder: Path
    scenario: rewire_jax.Scenario
    settings: rewire_jax.Settings

    @property
    def started(self) -> bool:
        """Whether the folder holds a run."""
        return (self.folder / HEADER).exists()

    @property
    def evaluated(self) -> bool:
        """Whether there is something to report on."""
        return self.started and (self.folder / TABLES[0]).exists()

    @property
    def result(self) -> RunData | None:
        """What it found, if nothing is left to be trained."""
        run = read_run(self.folder) if self.evaluated else None
        return run if run and run.complete else None

    @property
    def finished(self) -> bool:
        """Whether nothing is left to be trained."""
        return self.result is not None


def train(runs: Sequence[Run], job: Job) -> list[Run]:
    """Trains the runs that are not finished, one after the other.

    Args:
      runs: in their order.
      job: whether to train at all.

    Returns:
      The runs that there is something to report on.

    Raises:
      UserError: wrong settings, or another run in a folder, before anything is run; or
        there is nothing to report on.
      rewire_jax.Stopped: interrupted; the same command continues.
    """
    # What is wrong is found before the first run has gone on for hours.
    for run in runs:
        plan = prepare(run.settings, run.scenario)
        if run.started:
            compare(run.folder, plan.settings)
    for run in runs if job.train else ():
        if run.finished:
            print(f"{run.folder}: finished before, not run again", file=sys.stderr)
            continue
        rewire_jax.train(
            run.settings, run.folder, scenario=run.scenario, resume=run.started
        )
    evaluated = [run for run in runs if run.evaluated]
    require(bool(evaluated), "none of the runs has results yet")
    return evaluated


def reports(
    runs: Sequence[Run], out: Path, success: Success = "any"
) -> list[Report[Comparison]]:
    """Writes a report for each scenario into a folder of its own.

    Args:
      runs: that have results.
      out: for the folders.
      success: see `rewire_jax.write_report`.
    """
    folders: dict[str, list[Path]] = {}
    for run in runs:
        name = run.settings.scenario.replace("/", "-")
        folders.setdefault(name, []).append(run.folder)
    return [
        rewire_jax.write_report(each, out / name, success=success)
        for name, each in folders.items()
    ]


def origins(made: Sequence[Report[Comparison]]) -> list[str]:
    """Markdown: what the reports are of, what is missing, where runs come from."""
    lines = []
    for report in made:
        lines += [f"- {report.title}", *(f"  - **{note}**" for note in report.notes)]
        lines += [f"  {line}" for line in report.origins]
    return lines


def grouped(
    rows: Iterable[Mapping[str, Any]], *names: str
) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Rows by their values of these columns, in the order of the first of each."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def write(
    path: Path,
    title: str,
    table: Sequence[Sequence[str]],
    notes: Sequence[str],
    rows: Sequence[dict[str, Any]],
) -> None:
    """Writes a result as Markdown, CSV and JSON, and prints it.

    Args:
      path: of the files, without a suffix.
      title: above the table.
      table: for people, its headings first.
      notes: lines of Markdown below it.
      rows: the numbers, all with the same columns.
    """
    made = provenance()
    shown = page(title, table, notes, made)
    result = {"title": title, "rows": rows, "provenance": made}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".md").write_text(shown, encoding="utf-8")
    path.with_suffix(".json").write_text(json_text(result))
    path.with_suffix(".csv").write_text(csv_text(rows))
    print(shown)
    print(*(path.with_suffix(end) for end in (".md", ".csv", ".json")), sep="\n")


def table(rows: Sequence[Row], columns: Columns) -> list[list[str]]:
    """For people: what the columns show of each row, their headings first."""
    return [[*columns], *([show(row) for show in columns.values()] for row in rows)]


def show(name: str, form: str = "", times: float = 1) -> Callable[[Row], str]:
    """A column: a value of the row so many times, or a dash where it has none."""

    def text(row: Row) -> str:
        value = row.get(name)
        if value is None:
            return "–"
        return format(value if times == 1 else times * value, form)

    return text


def page(
    title: str,
    table: Sequence[Sequence[str]],
    notes: Sequence[str],
    made: Mapping[str, Any],
) -> str:
    """Markdown of a result, see `write`; `made` is its provenance."""
    head, *body = table
    lines = [f"# {title}", "", *to_markdown(head, body), *notes]
    below = f"Made on {how_made(made)}."
    return "\n".join(lines).rstrip("\n") + f"\n\n{below}\n"


def command(kind: type[T], run: Callable[[T], Any], name: str) -> None:
    """Reads the command line and runs; exits with 2 on a user's error."""
    rewire_jax.keep_compiled()
    try:
        run(tyro.cli(kind, prog=f"python -m experiments.{name}"))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except rewire_jax.Stopped:
        print("stopped and saved: repeat the command to continue", file=sys.stderr)
        sys.exit(130)
