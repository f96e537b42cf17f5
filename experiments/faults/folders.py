"""Two processes on one folder, at once or one after the other."""

import shutil
import signal
import socket
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from experiments.faults import base, kills
from experiments.faults.base import TRAIN, Case, Kind, Outcome, Ran
from experiments.faults.kills import SWEEP, Moment

_RESUME = ("--resume",)


def together(*arguments: str | Path) -> list[Ran]:
    """Two processes that share a sweep, as one command of theirs each starts them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    words = [*arguments, "--coordinator", address, "--processes", "2"]
    pair = [base.start(*words, "--process", str(number)) for number in range(2)]
    return [base.end(process) for process in pair]


def alone(*arguments: str | Path) -> list[Ran]:
    """One process."""
    return [base.run(*arguments)]


def during(
    arguments: Sequence[str],
    inside: str,
    second: Callable[..., list[Ran]],
    more: Sequence[str],
    place: Path,
) -> Outcome:
    """A command comes upon the folder of one that runs: it ends, the other goes on.

    Args:
      arguments: of both, without --out.
      inside: the folder in theirs in which the first has begun to train.
      second: runs the second.
      more: arguments of the second alone.
      place: a new folder.
    """
    whole, folder = base.unbroken(place, *arguments), place / "run"
    process = base.start(*arguments, "--out", folder)
    begun = Moment("report 2", partial(kills.rows, "training.jsonl", 4), 0.0)
    kills.wait(process, folder / inside, begun)
    # It must not end before the second has looked.
    process.send_signal(signal.SIGSTOP)
    others = second(*arguments, "--out", folder, *more)
    process.send_signal(signal.SIGCONT)
    return Outcome(
        others[0].said,
        base.first(
            *(base.complaint(ran, str(folder), "--out") for ran in others),
            base.failed(base.end(process)),
            base.different(folder, whole),
        ),
        base.lost(base.results(whole), folder),
    )


def at_once(arguments: Sequence[str], place: Path) -> Outcome:
    """The same command twice at the same time: one of them has the folder."""
    whole, folder = base.unbroken(place, *arguments), place / "run"
    pair = [base.start(*arguments, "--out", folder) for _ in range(2)]
    ran = sorted(base.end(process) for process in pair)
    return Outcome(
        ran[1].said,
        base.first(
            base.failed(ran[0]),
            base.complaint(ran[1], str(folder), "--out"),
            base.different(folder, whole),
        ),
        base.lost(base.results(whole), folder),
    )


def again(
    arguments: Sequence[str],
    inside: str,
    stopped: bool,
    second: Callable[..., list[Ran]],
    place: Path,
) -> Outcome:
    """A command without --resume comes upon an old folder, and leaves it as it is.

    Args:
      arguments: of both, without --out.
      inside: the folder in theirs in which the first was killed, if it was.
      stopped: whether it was.
      second: runs the second.
      place: a new folder.
    """
    whole, folder = base.unbroken(place, *arguments), place / "run"
    wrong = ""
    if stopped:
        seen = partial(kills.reached, "task-001-step-0000020")
        moment = Moment("a checkpoint", seen, 0.05)
        wrong = kills.kill(folder / inside, moment, *arguments, "--out", folder)
    else:
        shutil.copytree(whole, folder)
    before = base.contents(folder)
    others = second(*arguments, "--out", folder)
    changed = "the folder was changed" if base.contents(folder) != before else ""
    wrong = base.first(
        wrong,
        *(base.complaint(ran, str(folder), "--resume") for ran in others),
        changed,
    )
    resumed = base.run(*arguments, "--out", folder, "--resume")
    return Outcome(
        others[0].said,
        base.first(wrong, base.failed(resumed), base.different(folder, whole)),
        base.lost(base.results(whole), folder),
    )


def _cases() -> list[Case]:
    first, second = "task-000/batch-000", "task-001/batch-000"
    cases = []
    for name, arguments, inside in (("run", TRAIN, ""), ("sweep", SWEEP, first)):
        for more in ((), _RESUME):
            words = " ".join(["a second", name, *more])
            tried = partial(during, arguments, inside, alone, more)
            cases.append(Case(words, tried))
        cases.append(Case(f"two of the same {name}", partial(at_once, arguments)))
    for name, arguments, inside in (("run", TRAIN, ""), ("sweep", SWEEP, second)):
        for stopped in (False, True):
            words = f"on a {'stopped' if stopped else 'finished'} {name}"
            tried = partial(again, arguments, inside, stopped, alone)
            cases.append(Case(words, tried))
    for stopped in (False, True):
        words = f"a pair on a {'stopped' if stopped else 'finished'} sweep"
        cases.append(Case(words, partial(again, SWEEP, second, stopped, together)))
    for more in ((), _RESUME):
        words = " ".join(["a pair upon a sweep", *more])
        cases.append(Case(words, partial(during, SWEEP, first, together, more)))
    return cases


KINDS = (
    Kind(
        "two",
        "two processes on one folder, of which one is refused",
        tuple(_cases()),
    ),
)
