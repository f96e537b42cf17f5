"""The words that a command is given, as settings; or, in a line, what is wrong."""

import argparse
import contextlib
import io
import itertools
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import tyro

from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import require
from rewire_jax.envs.scenarios import Scenario, make_scenario
from rewire_jax.training.presets import preset

T = TypeVar("T")


def parse(kind: type[T], name: str, arguments: Sequence[str], **options: Any) -> T:
    """Reads arguments with tyro.

    Raises:
      UserError: an argument is unknown, missing or no value of its kind; tyro says
        so in a box, of which this is the first part, and the flags in the second.
    """
    prog, box = f"rewire-jax {name}", io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(kind, prog=prog, args=list(arguments), **options)
    except SystemExit as exit_:
        if not exit_.code:
            raise
        # Drawn with minus signs and bars where the terminal has no better.
        lines = [line.strip("│| ") for line in box.getvalue().splitlines()[1:]]
        parts = itertools.groupby(lines, lambda line: bool(line.strip("─╰╯-+")))
        said, hint, *_ = [*(" ".join(part) for text, part in parts if text), "", ""]
        close = re.findall(r"--[a-z-]+", hint) if hint.startswith("Perhaps") else []
        meant = f"; perhaps you meant {' or '.join(close)}" if close else ""
        said = " ".join(said.split()).rstrip(".")
        raise UserError(f"{said}{meant}; see {prog} --help") from None


def peek(arguments: Sequence[str], **defaults: str | None) -> list[Any]:
    """Values of flags that must be known before the rest is read."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name, default in defaults.items():
        parser.add_argument(f"--{name}", default=default)
    known, _ = parser.parse_known_args(arguments)
    return [getattr(known, name) for name in defaults]


def with_settings(
    kind: Callable[..., T], name: str, arguments: Sequence[str]
) -> tuple[Scenario, T]:
    """Reads arguments that begin with a scenario and hold settings of a run.

    Raises:
      UserError: as in `parse`; or there is no scenario, or an unknown one.
    """
    # The settings' defaults depend on these, so they are read before the rest.
    method, profile, backend, reward = peek(
        arguments, method="rewire", profile="paper", backend=None, reward="v2"
    )
    given = bool(arguments) and not arguments[0].startswith("-")
    require(
        given or "--help" in arguments or "-h" in arguments,
        f"{name} needs a scenario: see `rewire-jax list`",
    )
    which = arguments[0] if given else "halfcheetah/forgetting"
    scenario = make_scenario(which, backend, reward)
    default = preset(scenario, method, profile)
    return (
        scenario,
        parse(
            kind,  # type: ignore[arg-type]
            f"{name} SCENARIO",
            arguments[1:] if given else arguments,
            default=kind(settings=default, out=tyro.MISSING),
            config=(tyro.conf.OmitArgPrefixes,),
        ),
    )


def read_axes(arguments: Sequence[str]) -> tuple[dict[str, list[float]], list[str]]:
    """The axes of a sweep by name, and the other arguments.

    Raises:
      UserError: an axis lacks a name or values, or is named twice.
    """
    short = {"k": "modes", "alpha": "alpha", "beta": "beta"}
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in short:
        parser.add_argument(f"--{name}", nargs="*", action="append", default=[])
    parser.add_argument("--axis", nargs="*", action="append", default=[])
    known, others = parser.parse_known_args(arguments)
    given = [[name, *values] for name in short for values in getattr(known, name)]
    axes: dict[str, list[float]] = {}
    for words in [*given, *known.axis]:
        require(len(words) > 1, f"an axis needs a name and values, not {words}")
        name, *values = words
        name = short.get(name, name.lstrip("-").replace("-", "_"))
        require(name not in axes, f"{name} is an axis twice")
        try:
            axes[name] = [float(value) for value in values]
        except ValueError as error:
            raise UserError(f"axis {name}: {error}") from None
    return axes, others
