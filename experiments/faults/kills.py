"""SIGKILL at random moments of a run or sweep, which then is resumed."""

import random
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from experiments.faults import base
from experiments.faults.base import SETTINGS, TRAIN, Case, Kind, Outcome

SWEEP = ("sweep", *TRAIN[1:], "--beta", "0.1", "10", "--members-per-batch", "2")
_SEED = 7
_LONGEST = 600.0  # seconds until a moment must have come


class Moment(NamedTuple):
    """When to kill: a while after something is seen in the folder of a run.

    Attributes:
      name: of what is seen.
      seen: whether it is, given that folder.
      delay: seconds.
    """

    name: str
    seen: Callable[[Path], bool]
    delay: float


def rows(table: str, number: int, folder: Path) -> bool:
    """Whether a table has so many rows."""
    path = folder / table
    return path.exists() and path.read_bytes().count(b"\n") >= number


def reached(name: str, folder: Path) -> bool:
    """Whether this checkpoint, or a later one, is being written or there."""
    names = (path.name for path in (folder / "checkpoints").glob("*task-*"))
    return any(each.removeprefix(".tmp-") >= name for each in names)


def kept(name: str, folder: Path) -> bool:
    """Whether this checkpoint is there."""
    return (folder / "checkpoints" / name).exists()


def moments(seed: int) -> list[list[Moment]]:
    """Twenty moments of a run, a list each; in some, the resumed run is killed, too.

    Four are at starts and four at ends of tasks, eight while checkpoints are written,
    and four somewhere.
    """
    draw = random.Random(seed)
    tasks, seeds = SETTINGS["tasks"], SETTINGS["seeds"]
    reports = SETTINGS["interactions"] // SETTINGS["report-every"]
    every = SETTINGS["checkpoint-every"] // SETTINGS["envs"]

    def start(task: int) -> Moment:
        name = f"task-{task:03d}"
        return Moment(f"{name} begins", partial(kept, name), draw.uniform(0, 0.1))

    def end(task: int) -> Moment:
        seen = partial(rows, "results.jsonl", (task + 2) * tasks * seeds)
        return Moment(f"task-{task:03d} ends", seen, draw.uniform(0, 0.03))

    def within(task: int) -> Moment:
        name = f"task-{task:03d}-step-{every * draw.randint(1, 3):07d}"
        seen = partial(reached, name)
        return Moment(f"{name} is written", seen, draw.uniform(0, 0.03))

    def whole(task: int) -> Moment:
        name = f"task-{task + 1:03d}"
        seen = partial(reached, name)
        return Moment(f"{name} is written", seen, draw.uniform(0, 0.03))

    def somewhere(task: int) -> Moment:
        number = task * reports + draw.randint(1, reports)
        seen = partial(rows, "training.jsonl", number * seeds)
        return Moment(f"report {number}", seen, draw.uniform(0, 0.3))

    made = []
    for number in range(4):
        for make in (start, end, within, whole, somewhere):
            # No task follows the last, and none is kept before the first.
            first = draw.randrange(1, tasks) if make is start else draw.randrange(tasks)
            some = [make(first)]
            if number == 0 and first < tasks - 1:
                some.append(draw.choice((start, end, within, whole))(tasks - 1))
            made.append(some)
    return made


def wait(process: subprocess.Popen[str], watched: Path, moment: Moment) -> None:
    """Waits for a moment, or the end of the process that should bring it about."""
    limit = time.monotonic() + _LONGEST
    while process.poll() is None and time.monotonic() < limit:
        if moment.seen(watched):
            time.sleep(moment.delay)
            break
        time.sleep(0.0005)


def kill(watched: Path, moment: Moment, *arguments: str | Path) -> str:
    """Runs `rewire-jax` and kills it; says so if it ended before, else ""."""
    process = base.start(*arguments)
    wait(process, watched, moment)
    process.kill()
    ran = base.end(process)
    ended = ran.status != -signal.SIGKILL
    return f"it ended before {moment.name}: {ran.err}" if ended else ""


def state(folder: Path) -> str:
    """What a kill has left: the newest checkpoint, and whether one was half written."""
    found = sorted(path.name for path in folder.rglob("checkpoints/*task-*"))
    newest = ([name for name in found if name[0] != "."] or ["no checkpoint"])[-1]
    half = ", another half written" if any(name[0] == "." for name in found) else ""
    return f"left with {newest}{half}"


def killed(
    arguments: Sequence[str], inside: str, some: Sequence[Moment], place: Path
) -> Outcome:
    """Kills a command at each of the moments in turn, and resumes it to its end.

    Args:
      arguments: of the command, without --out.
      inside: the folder in that of the command in which the moments are seen.
      some: moments.
      place: a new folder.
    """
    whole = base.unbroken(place, *arguments)
    folder, wrong, left = place / "run", "", []
    for number, moment in enumerate(some):
        resume = ("--resume",) if number else ()
        wrong = wrong or kill(
            folder / inside, moment, *arguments, *resume, "--out", folder
        )
        left.append(state(folder))
    resumed = base.run(*arguments, "--out", folder, "--resume")
    return Outcome(
        "; ".join(left),
        base.first(wrong, base.failed(resumed), base.different(folder, whole)),
        base.lost(base.results(whole), folder),
    )


def _case(arguments: Sequence[str], inside: str, some: Sequence[Moment]) -> Case:
    name = ", then ".join(f"{m.name} + {1e3 * m.delay:.0f} ms" for m in some)
    return Case(f"{inside} {name}".strip(), partial(killed, arguments, inside, some))


def _sweeps(seed: int) -> tuple[Case, ...]:
    """Four moments in batches of a sweep's tasks."""
    draw = random.Random(seed)
    cases = []
    for _ in range(4):
        task, batch = draw.randrange(SETTINGS["tasks"]), draw.randrange(2)
        name = draw.choice((f"task-{task:03d}-step-0000020", f"task-{task + 1:03d}"))
        seen = partial(reached, name)
        moment = Moment(f"{name} is written", seen, draw.uniform(0, 0.1))
        cases.append(_case(SWEEP, f"task-{task:03d}/batch-{batch:03d}", [moment]))
    return tuple(cases)


def _runs(writing: bool) -> tuple[Case, ...]:
    """The moments of a run while a checkpoint is written, or the others."""
    return tuple(
        _case(TRAIN, "", some)
        for some in moments(_SEED)
        if some[0].name.endswith("written") == writing
    )


KINDS = (
    Kind("kill", "a run is killed (SIGKILL), and resumed", _runs(writing=False)),
    Kind(
        "kill-writing",
        "a run is killed while it writes a checkpoint, and resumed",
        _runs(writing=True),
    ),
    Kind("kill-sweep", "a sweep is killed, and resumed", _sweeps(_SEED)),
)
