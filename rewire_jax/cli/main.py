"""The `rewire-jax` command."""

import argparse
import contextlib
import dataclasses
import json
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import tyro
from rich.console import Console

from rewire_jax.cli.arguments import parse, peek, read_axes, with_settings
from rewire_jax.core.compilation_cache import keep_compiled
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings, require
from rewire_jax.envs.scenarios import list_scenarios, make_scenario
from rewire_jax.methods import METHODS
from rewire_jax.rendering import render
from rewire_jax.reports.report import to_terminal
from rewire_jax.reports.write import write_report
from rewire_jax.run import evaluation, interrupts, sweep, train_run
from rewire_jax.storage.scores import Success
from rewire_jax.training import population
from rewire_jax.version import __version__

_INTERRUPTED = 130


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train:
    """Learns the tasks of a scenario, one after the other.

    Attributes:
      settings: of the run.
      out: folder of the run, new or empty.
      resume: continue the run in that folder from its newest checkpoint.
      log: where scalars go, too: tensorboard, wandb, or both.
    """

    settings: Settings
    out: Path
    resume: bool = False
    log: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sweep:
    """Trains every combination of settings with every seed as one population.

    Several values make a setting an axis: --k 1 2 3, --alpha 0 1e-6 1e-5,
    --beta 0.1 1 10, and any other number by --axis NAME VALUE ..., such as --axis tau
    0.1 1 or --axis lr-policy 1e-4 1e-3. All members learn a task before the next.

    Attributes:
      settings: of all members.
      out: folder of the sweep, new or empty.
      resume: continue the sweep in that folder.
      random: so many random configurations, with the axes' two values as ranges,
        instead of every combination.
      halving: after each task only the best 1 in so many configurations go on.
      members_per_batch: trained side by side at most; 0 for as many as fit.
      coordinator: HOST:PORT of the first of several processes, on one file system;
        give each the same command.
      processes: how many there are, where no cluster manager says so.
      process: number of this one from 0, where no cluster manager says so.
      log: where scalars go, too: tensorboard, wandb, or both.
    """

    settings: Settings
    out: Path
    resume: bool = False
    random: int = 0
    halving: int = 1
    members_per_batch: int = 0
    coordinator: str | None = None
    processes: int | None = None
    process: int | None = None
    log: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Plays the tasks of a run with what it has learned, without exploration.

    Attributes:
      run: folder of the run.
      stage: as it was after this task's training; the latest if not given.
      episodes: for each task.
      seed: of the episodes, not of the run.
      json: print rows as JSON instead of a table.
    """

    run: tyro.conf.Positional[Path]
    stage: int | None = None
    episodes: int = 128
    seed: int = 0
    json: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Render:
    """Shows an episode of a run: a web page, and a GIF where MuJoCo can draw one.

    Attributes:
      run: folder of the run, or of a sweep.
      task: which of the sequence to play, from 0.
      seed: whose policy; the run's first if not given.
      stage: as it was after this task's training; the latest if not given.
      member: of a sweep, in place of the seed: a number in members.csv.
      episode: which one; where it starts follows from this number.
      out: the page; the GIF lies beside it.
      seconds: of the episode in the GIF; 0 for no GIF.
    """

    run: tyro.conf.Positional[Path]
    task: int
    seed: int | None = None
    stage: int | None = None
    member: int | None = None
    episode: int = 0
    out: Path = Path("episode.html")
    seconds: float = 10.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Report:
    """Tables and pictures of runs on the same scenario, from their files alone.

    Attributes:
      runs: folders of the runs, finished or not; a SAC-N run normalises the others. Or
        the folder of one sweep.
      out: folder for the report; an earlier report there is replaced.
      single: folders of runs that learn one task each, with the same budget: from
        them Continual World's forward transfer is measured.
      success: steps of an episode that count as solved, any or the last alone.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    out: Path = Path("report")
    single: tuple[Path, ...] = ()
    success: Success = "any"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Info:
    """Tasks, budgets, backend, and the model size of each method.

    Attributes:
      scenario: its name.
      backend: physics backend; the domain's first if not given.
      json: print JSON instead of text.
    """

    scenario: tyro.conf.Positional[str]
    backend: str | None = None
    json: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class List:
    """Scenarios and methods.

    Attributes:
      json: print JSON instead of text.
    """

    json: bool = False


def _train(arguments: Sequence[str]) -> None:
    scenario, train = with_settings(Train, "train", arguments)
    folder = train_run.train(
        train.settings,
        train.out,
        scenario=scenario,
        resume=train.resume,
        log=train.log,
    )
    print(f"finished: results, checkpoints and settings are in {folder}")


def _sweep(arguments: Sequence[str]) -> None:
    axes, others = read_axes(arguments)
    # Processes join before JAX looks for its devices, as making a scenario does.
    coordinator, *numbers = peek(others, coordinator=None, processes=None, process=None)
    for number in numbers:
        require(
            number is None or (number.isdecimal() and bool(coordinator)),
            "--processes and --process are whole numbers, and need --coordinator",
        )
    if coordinator:
        processes, process = (n if n is None else int(n) for n in numbers)
        population.join(coordinator, processes, process)
    scenario, asked = with_settings(Sweep, "sweep", others)
    folder = sweep.sweep(
        asked.settings,
        asked.out,
        axes=axes,
        random=asked.random,
        halving=asked.halving,
        members_per_batch=asked.members_per_batch,
        scenario=scenario,
        resume=asked.resume,
        log=asked.log,
    )
    if jax.process_index() == 0:
        print(to_terminal(write_report([folder], folder)), end="")


def _evaluate(arguments: Sequence[str]) -> None:
    asked = parse(Evaluate, "evaluate", arguments)
    rows = evaluation.evaluate(
        asked.run, stage=asked.stage, episodes=asked.episodes, seed=asked.seed
    )
    if asked.json:
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


def _render(arguments: Sequence[str]) -> None:
    made = render.render(**vars(parse(Render, "render", arguments)))
    lines = made.title, made.caption, made.page, made.gif or made.note
    print(*filter(None, lines), sep="\n")


def _report(arguments: Sequence[str]) -> None:
    asked = parse(Report, "report", arguments)
    made = write_report(
        asked.runs, asked.out, single=asked.single, success=asked.success
    )
    print(to_terminal(made), end="")


def _info(arguments: Sequence[str]) -> None:
    asked = parse(Info, "info", arguments)
    facts = evaluation.info(make_scenario(asked.scenario, asked.backend))
    if asked.json:
        print(json.dumps(facts, indent=1))
        return
    print(
        f"{facts['scenario']} on {facts['backend']}: {len(facts['tasks'])} tasks of "
        f"{facts['interactions']:,} interactions, observation "
        f"{facts['observation_size']}, action {facts['action_size']}"
    )
    for number, task in enumerate(facts["tasks"]):
        print(f"  {number} {task['name']}")
    print("model size, in plain policies:")
    for method, size in facts["model_size"].items():
        print(f"  {method:<10}{size:.2f}")


def _list(arguments: Sequence[str]) -> None:
    asked = parse(List, "list", arguments)
    names = {"scenarios": list(list_scenarios()), "methods": sorted(METHODS)}
    if asked.json:
        print(json.dumps(names, indent=1))
        return
    for title, entries in names.items():
        print(f"{title}:", *entries, sep="\n  ")


def _keep(arguments: Sequence[str]) -> list[str]:
    """Keeps what is compiled as --cache says; returns the other arguments."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--cache", nargs="?", const="")
    known, others = parser.parse_known_args(arguments)
    require(known.cache != "", "--cache needs a folder, or off")
    keep_compiled(known.cache)
    return others


_COMMANDS = {
    "train": _train,
    "sweep": _sweep,
    "evaluate": _evaluate,
    "render": _render,
    "report": _report,
    "info": _info,
    "list": _list,
}
_USAGE = """usage: rewire-jax COMMAND ...

  train SCENARIO --out RUN [--method M] [--profile P] [--resume] [--SETTING VALUE ...]
      learn the tasks of a scenario, one after the other
      (`rewire-jax train SCENARIO --help` lists all settings and their values)
  sweep SCENARIO --out SWEEP [--k 1 2 3] [--axis NAME VALUE ...] [--SETTING VALUE ...]
      the same for every combination of settings and every seed, as one program
  evaluate RUN    play the tasks of a run with what it has learned
  render RUN --task T
      show an episode of a run as a web page, and as a GIF where that can be drawn
  report RUN...   tables and pictures of runs, side by side
  info SCENARIO   tasks, budgets, backend, and the model size of each method
  list            scenarios and methods

`rewire-jax COMMAND --help` says more, `rewire-jax --version` which version this is.
What is compiled is kept for later commands in ~/.cache/rewire_jax; `--cache DIR` with
any command names another folder, and `--cache off` keeps nothing. `--debug` with any
command shows where an error comes from.
"""


@contextlib.contextmanager
def _stoppable() -> Iterator[None]:
    """A second Ctrl-C ends the process if it does not end by itself in a second."""
    heard, over = threading.Event(), threading.Event()

    def end(times: int) -> None:
        heard.set()
        if times == 2 and not over.wait(1.0):
            # A live display has hidden the cursor.
            Console(stderr=True).show_cursor()
            print(
                "stopped at once: what was saved stays; training goes on with --resume",
                file=sys.stderr,
                flush=True,
            )
            os._exit(_INTERRUPTED)

    with interrupts.noticed(end):
        try:
            yield
        finally:
            over.set()
            if heard.is_set():  # The process ends, and has no more to say.
                signal.signal(signal.SIGINT, signal.SIG_IGN)


def _ending(error: BaseException) -> tuple[str, int]:
    """The line in which a command ends, and its exit status."""
    if isinstance(error, UserError):
        return f"error: {error}", 2
    if isinstance(error, train_run.Stopped):
        return str(error), _INTERRUPTED
    if isinstance(error, KeyboardInterrupt):
        stopped = isinstance(error.__context__, train_run.Stopped)  # and then again
        return str(error.__context__) if stopped else "interrupted", _INTERRUPTED
    said = f"{type(error).__name__}: {error}".partition("\n")[0]
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in said:
        return (
            "error: out of memory: lower --seeds, --envs, --buffer, --hidden or "
            "--eval-episodes",
            2,
        )
    return (
        f"error: unexpected {said}; run again with --debug to see where, and please "
        "report it",
        1,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a command.

    Exits with 2 on a user's error, 130 on an interruption, 1 on what is unexpected.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    arguments = [word for word in arguments if word != "--debug"]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_USAGE, end="")
        sys.exit(0 if arguments else 2)
    if arguments[0] == "--version":
        print(f"rewire_jax {__version__}")
        return
    if not debug:
        # When a write fails, those beside it still report to Orbax, which has gone.
        sys.unraisablehook = lambda _: None
        logging.getLogger("asyncio").disabled = True
    name, *rest = arguments
    try:
        known = ", ".join(_COMMANDS)
        require(name in _COMMANDS, f"unknown command {name!r}: choose one of {known}")
        with _stoppable():
            _COMMANDS[name](_keep(rest))
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        line, status = _ending(error)
        print(line, file=sys.stderr)
        sys.exit(status)


if __name__ == "__main__":
    main()
