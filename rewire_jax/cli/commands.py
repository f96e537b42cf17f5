"""The commands of `rewire-jax`: their arguments, and what each of them does.

The docstrings are the help texts.
"""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

import tyro

from rewire_jax.core.settings import Settings, require
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
class Flags:
    """What every command can be given.

    Attributes:
      cache: folder for compiled programs, ~/.cache/rewire_jax by default; "off" keeps
        none.
      debug: show the traceback of an error.
      version: show the version.
    """

    cache: str | None = None
    debug: tyro.conf.FlagCreatePairsOff[bool] = False
    version: tyro.conf.FlagCreatePairsOff[bool] = False


@dataclass(frozen=True, kw_only=True)
class Train(Flags):
    """Trains on the tasks of a scenario, one after the other.

    Attributes:
      scenario: name of the task sequence.
      settings: of the run.
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
        """Trains, on a scenario that is made already."""
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

    A setting with several values is an axis: `--k 1 2 3`, `--alpha 0 1e-6 1e-5`,
    `--beta 0.1 1 10`, and for any other number `--axis NAME VALUE...`, for example
    `--axis tau 0.1 1`. All members finish a task before the next task starts.

    Attributes:
      scenario: name of the task sequence.
      settings: of all members.
      out: folder for the sweep, new or empty.
      axis: a setting and its values; repeat the flag for more axes.
      resume: continue the sweep in this folder.
      random: number of random configurations, instead of all combinations. Each axis
        then has two values, the ends of its range.
      halving: after each task, keep the best 1 / HALVING of the configurations.
      members_per_batch: most members trained at the same time; 0 for as many as fit.
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
        """Trains, on a scenario that is made already."""
        given = [(name.replace("-", "_"), values) for name, values in self.axis]
        for name, count in Counter(name for name, _ in given).items():
            require(count == 1, f"{name} is an axis twice: give its values at once")
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
class Evaluate(Flags):
    """Plays the tasks of a run with the trained policies, without exploration.

    Attributes:
      run: folder of the run.
      stage: use the policies as they were after this task; the latest by default.
      episodes: number of episodes for each task.
      seed: of the episodes, not of the run.
      json: print rows as JSON instead of a table.
    """

    run: tyro.conf.Positional[Path]
    stage: int | None = None
    episodes: int = 128
    seed: int = 0
    json: bool = False

    def __call__(self) -> None:
        """Evaluates."""
        rows = evaluation.evaluate(
            self.run, stage=self.stage, episodes=self.episodes, seed=self.seed
        )
        if self.json:
            print("\n".join(json.dumps(row) for row in rows))
            return
        solved = [name for name in ("success", "success_last") if name in rows[0]]
        heads = "".join(f"{name:>14}" for name in solved)
        print(f"{'task':<28}{'seed':>6}{'return':>12}{'std':>10}{'steps':>10}{heads}")
        for row in rows:
            task = f"{row['task']} {row['name']}"
            shares = "".join(f"{row[name]:>14.2f}" for name in solved)
            print(
                f"{task:<28}{row['seed']:>6}{row['return']:>12.1f}{row['std']:>10.1f}"
                f"{row['steps']:>10}{shares}"
            )


@dataclass(frozen=True, kw_only=True)
class Render(Flags):
    """Shows an episode of a run as a web page, and as a GIF where MuJoCo can draw.

    Attributes:
      run: folder of the run or sweep.
      task: which task to play, from 0.
      seed: whose policy to use; the first seed's by default.
      stage: use the policy as it was after this task; the latest by default.
      member: of a sweep, instead of a seed: its number in members.csv.
      episode: number of the episode; it determines where the episode starts.
      out: the page; the GIF is written next to it.
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
        """Renders."""
        made = render.render(**vars(self))
        lines = made.title, made.caption, made.page, made.gif or made.note
        print(*filter(None, lines), sep="\n")


@dataclass(frozen=True, kw_only=True)
class Report(Flags):
    """Writes tables and plots of runs on the same scenario, from their files alone.

    Attributes:
      runs: folders of runs, finished or not, or of one sweep. A SAC-N run among them
        normalises the others.
      out: folder for the report; an earlier report there is replaced.
      single: folders of runs on one task each, with the same budget; with them the
        report has Continual World's forward transfer.
      success: count an episode as solved if any step is, or only the last.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    out: Path = Path("report")
    single: tuple[Path, ...] = ()
    success: Success = "any"

    def __call__(self) -> None:
        """Reports."""
        made = write_report(
            self.runs, self.out, single=self.single, success=self.success
        )
        print(to_terminal(made), end="")


@dataclass(frozen=True, kw_only=True)
class Info(Flags):
    """Shows tasks, budgets, backend, and the model size of each method.

    Attributes:
      scenario: name of the task sequence.
      backend: physics backend; the domain's first by default.
      json: print JSON instead of text.
    """

    scenario: tyro.conf.Positional[str]
    backend: str | None = None
    json: bool = False

    def __call__(self) -> None:
        """Informs."""
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
            print(f"  {method:<10}{size:.2f}")


@dataclass(frozen=True, kw_only=True)
class List(Flags):
    """Lists scenarios and methods.

    Attributes:
      json: print JSON instead of text.
    """

    json: bool = False

    def __call__(self) -> None:
        """Lists."""
        names = {"scenarios": list(list_scenarios()), "methods": sorted(METHODS)}
        if self.json:
            print(json.dumps(names, indent=1))
            return
        for title, entries in names.items():
            print(f"{title}:", *entries, sep="\n  ")


Command = Train | Sweep | Evaluate | Render | Report | Info | List
COMMANDS: dict[str, type[Command]] = {
    kind.__name__.lower(): kind for kind in get_args(Command)
}
