"""What nobody has thought of: errors that no command expects."""

import sys
from functools import partial
from pathlib import Path

from experiments.faults import base
from experiments.faults.base import Case, Kind, Outcome
from rewire_jax.cli.commands import COMMANDS

_BROKEN = """
from rewire_jax.cli import commands, main

def broken(*_):
    raise RuntimeError("a surprise\\nof two lines")

for command in commands.COMMANDS.values():
    command.__call__ = broken
main.main()
"""
_NEEDED = {
    "train": ("probe/reach", "--out", "run"),
    "sweep": ("probe/reach", "--out", "sweep"),
    "evaluate": ("run",),
    "render": ("run", "--task", "0"),
    "info": ("probe/reach",),
}


def surprised(command: str, place: Path) -> Outcome:
    """A command fails in a way of its own: in one line, and --debug says where."""
    words = [sys.executable, "-c", _BROKEN, command, *_NEEDED.get(command, ())]
    ran, debugged = (
        base.execute([*words, *more], place) for more in ((), ("--debug",))
    )
    told = "Traceback" in debugged.err and "in broken" in debugged.err
    return Outcome(
        ran.said,
        base.first(
            base.complaint(ran, "RuntimeError: a surprise", "--debug", status=1),
            "" if told else f"no traceback with --debug: {debugged.err}",
        ),
        0,
    )


KINDS = (
    Kind(
        "surprise",
        "an error that a command does not expect; --debug says where it is",
        tuple(Case(name, partial(surprised, name)) for name in COMMANDS),
    ),
)
