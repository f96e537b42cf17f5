"""What the kinds of faults share: commands to run, results to lose, and a judgement."""

import hashlib
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import orbax.checkpoint as ocp

from rewire_jax.storage.run_folder import TABLES

SETTINGS: dict[str, Any] = {
    "profile": "quick",
    "seeds": 2,
    "tasks": 3,
    "interactions": 640,
    "envs": 16,
    "updates": 4,
    "warmup": 160,
    "eval-episodes": 2,
    "selection-episodes": 2,
    "report-every": 80,
    "checkpoint-every": 160,
    "hidden": 8,
    "depth": 1,
    "batch-size": 16,
}
"""Of runs that take seconds: three tasks, each of eight reports, three checkpoints."""


def train(scenario: str = "probe/reach", **changes: int) -> tuple[str, ...]:
    """A small run of `rewire`, without --out.

    Args:
      scenario: that is learned.
      changes: to `SETTINGS`, by names with underscores.
    """
    values = SETTINGS | {name.replace("_", "-"): x for name, x in changes.items()}
    flags = (str(word) for n, v in values.items() for word in (f"--{n}", v))
    return ("train", scenario, *flags)


TRAIN = train()
"""It keeps memory, and chooses among modes."""

_QUICKLY = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"


class Impossible(Exception):
    """A case that cannot be tried on this machine; the message says why."""


class Outcome(NamedTuple):
    """What came of a case.

    Attributes:
      said: the line in which the command ended, "" where it went to its end.
      wrong: what was not as it should be, "" if all was.
      lost: results that were finished and are gone, or are others now.
    """

    said: str
    wrong: str
    lost: int

    @property
    def ok(self) -> bool:
        """Whether all was as it should be."""
        return not self.wrong and not self.lost


class Case(NamedTuple):
    """A fault of some kind.

    Attributes:
      name: unlike the other cases' of its kind.
      run: given a folder of its own, new and empty, tries the fault, or raises
        `Impossible`. What cases can share is beside that folder; see `unbroken`.
    """

    name: str
    run: Callable[[Path], Outcome]


class Kind(NamedTuple):
    """A kind of faults.

    Attributes:
      name: short, for the command line.
      title: for the table: what happens.
      cases: all of them.
    """

    name: str
    title: str
    cases: tuple[Case, ...]


class Ran(NamedTuple):
    """A command that has ended: its exit status, standard output and error."""

    status: int
    out: str
    err: str

    @property
    def said(self) -> str:
        """The last line on standard error."""
        return (self.err.splitlines() or [""])[-1]


def environment() -> dict[str, str]:
    """For processes that compute little: compiled quickly rather than well."""
    return {"XLA_FLAGS": _QUICKLY, **os.environ}


def words(arguments: Sequence[str | Path]) -> list[str]:
    """The whole command line of `rewire-jax` with these arguments."""
    return [sys.executable, "-m", "rewire_jax.cli.main", *map(str, arguments)]


def run(*arguments: str | Path, before: Sequence[str] = (), **others: str) -> Ran:
    """Runs `rewire-jax` in a process of its own.

    Args:
      arguments: of the command.
      before: words of a command that runs it.
      others: environment variables.
    """
    return execute([*before, *words(arguments)], **others)


def execute(
    command: Sequence[str], folder: Path | None = None, /, **others: str
) -> Ran:
    """Runs any command, in this folder; otherwise like `run`."""
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment() | others,
        check=False,
    )
    return Ran(done.returncode, done.stdout, done.stderr)


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    """Starts `rewire-jax`, to be ended by `end`."""
    return subprocess.Popen(
        words(arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )


def end(process: subprocess.Popen[str]) -> Ran:
    """Waits for the end of a command."""
    out, err = process.communicate()
    return Ran(process.returncode, out, err)


def unbroken(beside: Path, *arguments: str) -> Path:
    """The folder that a command fills when nothing goes wrong; to be left as it is.

    Args:
      beside: a case's folder. The commands of several cases are run once.
      arguments: without --out.
    """
    name = hashlib.sha256(" ".join(arguments).encode()).hexdigest()[:12]
    folder = beside.parent / f"unbroken-{name}"
    if not folder.exists():
        made = folder.with_suffix(".part")
        done = run(*arguments, "--out", made)
        if done.status:
            raise RuntimeError(f"{' '.join(arguments)}: {done.err}")
        made.rename(folder)
    return folder


def results(folder: Path) -> Counter[str]:
    """What is finished in the folder of a run or sweep, each result as a line.

    Results are the whole rows of evaluations and of training, and the arrays of what
    is kept of each task. What else a run writes tells how long it took, or is needed
    to go on.
    """
    found: list[str] = []
    for table in TABLES[:2]:
        for path in folder.rglob(table):
            at = path.relative_to(folder)
            rows = path.read_text().split("\n")[:-1]
            found += [f"{at} {row}" for row in rows]
    for item in folder.rglob("checkpoints/task-[0-9][0-9][0-9]/[a-z]*"):
        if item.is_dir():
            found += [f"{item.relative_to(folder)} {_digest(item)}"]
    return Counter(found)


def _digest(item: Path) -> str:
    """Of the arrays that Orbax has in a folder, whatever their files look like."""
    with ocp.PyTreeCheckpointer() as orbax:
        arrays: dict[str, Any] = orbax.restore(item)
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()


def contents(folder: Path) -> dict[Path, bytes]:
    """All files of a folder, but for locks."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path: path.read_bytes() for path in files if path.name != ".lock"}


def lost(expected: Counter[str], folder: Path) -> int:
    """How many results are not in a folder, bit for bit, that should be."""
    return (expected - results(folder)).total()


def different(folder: Path, whole: Path) -> str:
    """Says if the final result is not that of the unbroken run; "" if it is."""
    ours, theirs = results(folder), results(whole)
    if ours == theirs:
        return ""
    missing, extra = (ours - theirs).total(), (theirs - ours).total()
    return f"{extra} results are missing and {missing} others are there"


def complaint(ran: Ran, *told: str, status: int = 2) -> str:
    """Says what is wrong with how a command failed; "" if nothing is.

    It should end with this status and, but for what training had to tell, in one
    line, that holds each of the words in `told`.
    """
    lines = ran.err.splitlines()
    others = [line for line in lines[:-1] if not _progress(line)]
    wrong = []
    if ran.status != status:
        wrong += [f"exit status {ran.status}, not {status}"]
    if "Traceback" in ran.err + ran.out:
        wrong += ["a traceback"]
    if others or not lines:
        wrong += [f"{len(others) + len(lines[-1:])} lines, not one"]
    wrong += [f"it does not say {word!r}" for word in told if word not in ran.said]
    return "; ".join(wrong) + (f": {ran.err}" if wrong else "")


def failed(ran: Ran) -> str:
    """Says so if a command did not end well; "" if it did."""
    return f"exit status {ran.status}: {ran.err}" if ran.status else ""


def first(*wrong: str) -> str:
    """The first thing that is wrong, "" if nothing is."""
    return next(filter(None, wrong), "")


def _progress(line: str) -> bool:
    said = ("finished in", "a member needs", "stopping after", "falling back")
    return any(part in line for part in said)
