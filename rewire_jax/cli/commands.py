"""The commands of `rewire-jax`: a class for each, with its arguments as fields.

The docstrings are the help texts.
"""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

import tyro

from rewire_jax.cli.campaign_command import Campaign
from rewire_jax.cli.evaluate_command import Evaluate
from rewire_jax.cli.flags import Flags
from rewire_jax.core.arguments import require
from rewire_jax.core.settings import Settings
from rewire_jax.envs.scenarios import Scenario, list_scenarios, make_scenario
from rewire_jax.methods import METHODS
from rewire_jax.rendering import render
from rewire_jax.reports.report import to_terminal
from rewire_jax.reports.write import write_report
from rewire_jax.run import evaluation, sweep, train_run
from rewire_jax.storage.scores import Success

Axes = Annotated[
    tuple[tuple[str, tuple[float, ...]], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(metavar="NAME VALUE..."),
]


@dataclass(frozen=True, kw_only=True)
class Train(Flags):
    """Trains on the tasks of a scenario, one after the other.

    Attributes:
      scenario: name of the task sequence.
      settings: settings of the run.
      out: folder for the run, new or empty.
      resume: continue the run in this folder from its newest checkpoint.
      log: also log scalars to tensorboard, wandb, or both.
    """

    scenario: tyro.conf.Positional[str]
    settings: Settings
    out: Path
    resume: bool = False
    log: tuple[str, ...] = ()

    def __call__(self, scenario: Scenario) -> None:
        """Trains on a scenario object, then prints the folder of the run."""
        folder = train_run.train(
            self.settings,
            self.out,
            scenario=scenario,
            resume=self.resume,
            log=self.log,
        )
        print(f"finished: results, checkpoints and settings are in {folder}")


@dataclass(frozen=True, kw_only=True)
class Sweep(Flags):
    """Trains every combination of settings with every seed as one population.

    A configuration is one combination. A member is one configuration with one seed. A
    setting with several values is an axis: `--modes 1 2 3`, `--alpha 0 1e-6 1e-5`,
    `--beta 0.1 1 10`, and `--axis NAME VALUE...` for other numeric settings of SAC and
    of the method, for example `--axis tau 0.1 1`. All members finish a task before the
    next task starts.

    Attributes:
      scenario: name of the task sequence.
      settings: settings that all members share.
      out: folder for the sweep, new or empty.
      axis: a setting and its values; repeat the flag for more axes. The setting must be
        marked as an axis in the documentation.
      resume: continue the sweep in this folder.
      random: number of random configurations, instead of all combinations. Each axis
        then has two values, the ends of its range, or one fixed value.
      halving: after each task, keep the best 1 / HALVING of the configurations.
      members_per_batch: largest number of members trained at the same time; 0 for as
        many as fit, but at most 8 for each CPU device.
      join: help the process that started or resumed the sweep in --out; give the same
        command otherwise.
      log: also log scalars to tensorboard, wandb, or both.
    """

    scenario: tyro.conf.Positional[str]
    settings: Settings
    out: Path
    axis: Axes = ()
    resume: bool = False
    random: int = 0
    halving: int = 1
    members_per_batch: int = 0
    join: bool = False
    log: tuple[str, ...] = ()

    def __call__(self, scenario: Scenario) -> None:
        """Trains on a scenario object, then prints the sweep's report."""
        given = [(name.replace("-", "_"), values) for name, values in self.axis]
        for name, count in Counter(name for name, _ in given).items():
            require(count == 1, f"{name} is an axis twice: give all its values once")
        for name, values in given:
            require(bool(values), f"--axis {name} needs values")
        folder = sweep.sweep(
            self.settings,
            self.out,
            axes=dict(given),
            random=self.random,
            halving=self.halving,
            members_per_batch=self.members_per_batch,
            scenario=scenario,
            resume=self.resume,
            join=self.join,
            log=self.log,
        )
        if self.join:
            print(f"finished: `rewire-jax report {folder}` shows the sweep")
        else:
            print(to_terminal(write_report([folder], folder)), end="")


@dataclass(frozen=True, kw_only=True)
class Render(Flags):
    """Writes an episode of a run as a web page, and as a GIF if MuJoCo can draw.

    Attributes:
      run: folder of the run or sweep.
      task: index of the task, from 0.
      seed: use the policy that was trained with this seed; by default the first seed.
      stage: use the policy as it was after this task, counted from 0; by default the
        latest finished task.
      member: in a sweep, use the policy of this member instead of a seed; members.csv
        lists the members.
      episode: number of the episode; it determines the initial state.
      out: file of the page; the GIF is written next to it.
      seconds: length of the GIF; 0 for no GIF.
    """

    run: tyro.conf.Positional[Path]
    task: int
    seed: int | None = None
    stage: int | None = None
    member: int | None = None
    episode: int = 0
    out: Path = Path("episode.html")
    seconds: float = 10.0

    def __call__(self) -> None:
        """Renders, then prints a summary of the episode and the files written."""
        made = render.render(
            self.run,
            task=self.task,
            seed=self.seed,
            stage=self.stage,
            member=self.member,
            episode=self.episode,
            out=self.out,
            seconds=self.seconds,
        )
        lines = made.title, made.caption, made.page, made.gif or made.note
        print(*filter(None, lines), sep="\n")


@dataclass(frozen=True, kw_only=True)
class Report(Flags):
    """Writes tables and plots of runs on the same scenario, only from their files.

    Attributes:
      runs: folders of runs, finished or not, or of one sweep. On Brax, all scores
        are divided by the performance of the SAC-N run, if there is exactly one and it
        is usable.
      out: folder for the report; an earlier report there is replaced.
      single: folders of runs on one task each, with the same budget; the report then
        includes Continual World's forward transfer.
      success: count an episode as solved if it is solved at any step, or only if it is
        solved at the last step.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    out: Path = Path("report")
    single: tuple[Path, ...] = ()
    success: Success = "any"

    def __call__(self) -> None:
        """Writes the report, then prints its tables."""
        made = write_report(
            self.runs, self.out, single=self.single, success=self.success
        )
        print(to_terminal(made), end="")


@dataclass(frozen=True, kw_only=True)
class Info(Flags):
    """Prints tasks, budgets, backend, and the model size of each method.

    Attributes:
      scenario: name of the task sequence.
      backend: physics backend; by default the first backend of the domain.
      json: print JSON instead of text.
    """

    scenario: tyro.conf.Positional[str]
    backend: str | None = None
    json: bool = False

    def __call__(self) -> None:
        """Prints the facts about the scenario, as text or as JSON."""
        facts = evaluation.info(make_scenario(self.scenario, self.backend))
        if self.json:
            print(json.dumps(facts, indent=1))
            return
        print(
            f"{facts['scenario']} on {facts['backend']}: {len(facts['tasks'])} tasks "
            f"of {facts['interactions']:,} interactions, observation "
            f"{facts['observation_size']}, action {facts['action_size']}"
        )
        for number, task in enumerate(facts["tasks"]):
            print(f"  {number} {task['name']}")
        print("model size, relative to one plain policy:")
        for method, size in facts["model_size"].items():
            stored = facts["stored_states"].get(method)
            more = f", and {stored:.2f} of stored states" if stored else ""
            print(f"  {method:<10}{size:.2f}{more}")


@dataclass(frozen=True, kw_only=True)
class List(Flags):
    """Prints the names of scenarios and methods.

    Attributes:
      json: print JSON instead of text.
    """

    json: bool = False

    def __call__(self) -> None:
        """Prints the names, as text or as JSON."""
        names = {"scenarios": list(list_scenarios()), "methods": sorted(METHODS)}
        if self.json:
            print(json.dumps(names, indent=1))
            return
        for title, entries in names.items():
            print(f"{title}:", *entries, sep="\n  ")


Command = Train | Sweep | Campaign | Evaluate | Render | Report | Info | List
COMMANDS: dict[str, type[Command]] = {
    kind.__name__.lower(): kind for kind in get_args(Command)
}
