"""Parses a command line into a command."""

import contextlib
import io
import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import tyro
from rich.text import Text

from rewire_jax.cli.commands import COMMANDS, Command, Sweep, Train
from rewire_jax.cli.flags import Flags
from rewire_jax.core.arguments import require
from rewire_jax.core.errors import UserError
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.training.presets import preset

T = TypeVar("T")

PROG = "rewire-jax"
_HELP = {"-h", "--help"}
_EXAMPLE = "halfcheetah/forgetting"  # whose defaults `train --help` shows
_AXES = {f"--{name}": ("--axis", name) for name in ("modes", "alpha", "beta")}


@dataclass(frozen=True, kw_only=True)
class First(Flags):
    """Arguments that are read first, because other defaults depend on them.

    Attributes:
      words: the command and its positional arguments.
      method: see `Settings`.
      profile: see `Settings`.
      backend: see `Settings`.
      reward: see `Settings`.
    """

    words: tyro.conf.Positional[tuple[str, ...]] = ()
    method: str = "rewire"
    profile: str = "paper"
    backend: str | None = None
    reward: str = "v2"


@dataclass(frozen=True, kw_only=True)
class Overview(Flags):
    """Continual reinforcement learning with rewirable neurons, and its baselines.

    `rewire-jax COMMAND --help` lists the flags of a command, and `rewire-jax train
    SCENARIO --method METHOD --help` all settings with their defaults.

    Attributes:
      command: what to do.
    """

    command: Command


def first(words: Sequence[str]) -> First:
    """Reads the arguments of `First` and skips the others.

    Raises:
      UserError: one of these flags has no value, or a wrong one.
    """
    for before, word in itertools.pairwise(["", *words]):
        name, equals, value = word.partition("=")
        empty = not word or (word.startswith("--") and equals and not value)
        require(not empty, f"{name or before or 'an argument'} has an empty value")
    known, _ = _parse(First, PROG, words, return_unknown_args=True, add_help=False)
    return known


def command(words: Sequence[str], known: First) -> Callable[[], None]:
    """Reads a command and its arguments.

    Args:
      words: all words of the command line.
      known: result of `first` for these words.

    Raises:
      UserError: the command or an argument is missing, unknown or wrong.
    """
    help_ = not _HELP.isdisjoint(words)
    name, place = (*known.words, "", "")[:2]
    kind = COMMANDS.get(name)
    if kind is None:
        if help_ and not name:
            _parse(Overview, PROG, ["--help"])
        wrong = f"unknown command {name!r}" if name else "no command"
        choices = ", ".join(COMMANDS)
        raise UserError(f"{wrong}: choose one of {choices}; see {PROG} --help")
    prog, words = f"{PROG} {name}", list(words)
    words.remove(name)
    if kind not in (Train, Sweep):
        return _parse(kind, prog, words)
    require(bool(place) or help_, f"give a scenario after {name}: see {PROG} list")
    scenario = make_scenario(place or _EXAMPLE, known.backend, known.reward)
    settings = preset(scenario, known.method, known.profile)
    default = kind(scenario=tyro.MISSING, settings=settings, out=tyro.MISSING)
    if kind is Sweep:
        words = [new for word in words for new in _AXES.get(word, (word,))]
    return partial(_parse(kind, prog, words, default=default), scenario)


def _parse(kind: type[T], prog: str, words: Sequence[str], **options: Any) -> Any:
    """Parses with tyro, but reports an error in one line.

    Raises:
      UserError: an argument is missing, unknown or wrong.
    """
    config = tyro.conf.OmitArgPrefixes, tyro.conf.PositionalMetavarFromFieldName
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(kind, prog=prog, args=words, config=config, **options)
    except SystemExit as exit_:
        if not exit_.code:
            raise
    # tyro only prints errors: in a box, in parts between horizontal lines, with help
    # texts indented.
    lines = Text.from_ansi(box.getvalue()).plain.splitlines()[1:-1]
    lines = [line[2:].rstrip("│ ") for line in lines if line[2:10].strip("│ ")]
    parts = re.split(r"(?m)^[─-]+$", "\n".join(lines))
    said = [" ".join(part.split()).rstrip(".") for part in parts if part.strip()]
    raise UserError(". ".join(x for x in said if not x.startswith("Argument help")))
