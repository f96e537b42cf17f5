"""Ctrl-C, once and twice, at random moments of a run or sweep."""

import os
import random
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from experiments.faults import base, kills
from experiments.faults.base import SETTINGS, TRAIN, Case, Kind, Outcome, Ran
from experiments.faults.kills import SWEEP, Moment

_SEED = 5
_MANY = 160_000
LONG = base.train(tasks=2, interactions=_MANY, report_every=_MANY, checkpoint_every=0)
"""Its tasks are a chunk each, which takes seconds."""
HOSTED = base.train(
    "continual_world/window-close",
    tasks=1,
    envs=2,
    update_every=10,
    eval_episodes=1,
    selection_episodes=1,
)
"""Its simulators are stepped on the host."""


def interrupt(
    arguments: Sequence[str], folder: Path, inside: str, moment: Moment, times: int
) -> Ran:
    """Runs a command and interrupts it, as a terminal does: it and its children.

    Args:
      arguments: of the command, without --out.
      folder: given to it as --out.
      inside: the folder in that one in which the moment is seen.
      moment: of the first Ctrl-C.
      times: how often; the next follows in the time that a person takes.
    """
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        process = subprocess.Popen(
            [*base.words(arguments), "--out", str(folder)],
            stdout=out,
            stderr=err,
            text=True,
            env=base.environment(),
            start_new_session=True,
        )
        kills.wait(process, folder / inside, moment)
        for number in range(times):
            if number:
                time.sleep(0.2)
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
        process.wait()
        for file in (out, err):
            file.seek(0)
        said = out.read(), err.read()
    return Ran(process.returncode, *said)


def interrupted(
    arguments: Sequence[str], inside: str, moment: Moment, times: int, place: Path
) -> Outcome:
    """A command is interrupted, says in a line how to go on, and is resumed."""
    whole = base.unbroken(place, *arguments)
    folder = place / "run"
    ran = interrupt(arguments, folder, inside, moment, times)
    wrong = base.complaint(ran, "--resume", status=130)
    resumed = base.run(*arguments, "--out", folder, "--resume")
    return Outcome(
        ran.said,
        base.first(wrong, base.failed(resumed), base.different(folder, whole)),
        base.lost(base.results(whole), folder),
    )


def in_a_chunk(place: Path) -> Outcome:
    """Twice, while a chunk of seconds is computed: it is not waited for."""
    folder = place / "run"
    moment = Moment("", partial(kills.kept, "task-001"), 0.5)
    ran = interrupt(LONG, folder, "", moment, 2)
    whole = base.unbroken(place, *LONG)
    rows = (folder / "training.jsonl").read_text().count("\n")
    waited = "the chunk was waited for" if rows > SETTINGS["seeds"] else ""
    resumed = base.run(*LONG, "--out", folder, "--resume")
    return Outcome(
        ran.said,
        base.first(
            base.complaint(ran, "--resume", status=130),
            waited,
            base.failed(resumed),
            base.different(folder, whole),
        ),
        base.lost(base.results(whole), folder),
    )


def _case(
    arguments: Sequence[str], inside: str, moment: Moment, times: int = 1
) -> Case:
    name = f"{inside} {moment.name} + {1e3 * moment.delay:.0f} ms".strip()
    return Case(name, partial(interrupted, arguments, inside, moment, times))


def _runs(times: int) -> list[Case]:
    """Four moments of a run that are not in what follows the last chunk."""
    some = [moment for moment, *_ in kills.moments(_SEED + times)]
    late = tuple(f"task-{SETTINGS['tasks'] - n:03d}" for n in (1, 0))
    first = [moment for moment in some if not moment.name.startswith(late)]
    cases = [_case(TRAIN, "", moment, times) for moment in first]
    return random.Random(_SEED).sample(cases, 4)


def _sweep(times: int) -> Case:
    inside = "task-001/batch-000"
    seen = partial(kills.reached, "task-001-step-0000010")
    return _case(SWEEP, inside, Moment("a checkpoint is written", seen, 0.01), times)


KINDS = (
    Kind(
        "interrupt",
        "Ctrl-C in a run or sweep, which then is resumed",
        (
            *_runs(1),
            _sweep(1),
            _case(
                HOSTED,
                "",
                Moment("report 2", partial(kills.rows, "training.jsonl", 4), 0.0),
            ),
        ),
    ),
    Kind(
        "interrupt-twice",
        "Ctrl-C twice in a run or sweep, which then is resumed",
        (*_runs(2), _sweep(2), Case("in a chunk of seconds", in_a_chunk)),
    ),
)
