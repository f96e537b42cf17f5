"""Settings that make no sense, generated from the settings that there are."""

import dataclasses
import json
import random
import sys
import typing
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from experiments.faults import base
from experiments.faults.base import TRAIN, Case, Kind, Outcome
from rewire_jax.core.settings import SacSettings, Settings, flag
from rewire_jax.methods import METHODS

_SEED = 17
_SCENARIO = "probe/reach"
_MANY = "2000000000"
# Given in another way, or of no meaning here.
_APART = ("scenario", "sac", "options", "paper_interactions", "overlap", "reward")

# A call of the library, whose one argument is JSON.
_CALL = """
import dataclasses, json, sys
import rewire_jax
name, value, out = json.loads(sys.argv[1])
scenario = rewire_jax.make_scenario("probe/reach")
settings = rewire_jax.preset(scenario, "rewire", "quick")
groups = {"sac": settings.sac, "options": settings.options}
try:
    for field, group in groups.items():
        if hasattr(group, name):
            changed = dataclasses.replace(group, **{name: value})
            settings = dataclasses.replace(settings, **{field: changed})
    if hasattr(settings, name):
        settings = dataclasses.replace(settings, **{name: value})
    rewire_jax.train(settings, out)
except rewire_jax.UserError as error:
    sys.exit(f"error: {error}")
"""


class Mistake(NamedTuple):
    """A command that cannot be.

    Attributes:
      words: of the command, with {out} for a folder that must not come to be.
      named: what its line must have, to say where the mistake is.
    """

    words: Sequence[str]
    named: str


class Setting(NamedTuple):
    """A setting: its name, its type, and a method that has it."""

    name: str
    kind: Any
    method: str

    @property
    def flag(self) -> str:
        """On the command line."""
        return flag(self.name)

    def given(self, *values: str, flag: str = "") -> tuple[str, ...]:
        """A command with the setting."""
        words = ("train", _SCENARIO, "--method", self.method, "--profile", "quick")
        return (*words, flag or self.flag, *values, "--out", "{out}")


def settings() -> Iterator[Setting]:
    """All settings."""
    groups = [(Settings, "ft1"), (SacSettings, "ft1")]
    groups += [(entry.settings, method) for method, entry in METHODS.items()]
    seen = set()
    for group, method in groups:
        hints = typing.get_type_hints(group)
        for field in dataclasses.fields(group):
            if (group, field.name) not in seen and field.name not in _APART:
                seen.add((group, field.name))
                yield Setting(field.name, hints[field.name], method)


def misspelt(draw: random.Random, known: Sequence[Setting]) -> Mistake:
    """Two letters of the name change places."""
    setting = draw.choice([s for s in known if len(set(s.name)) > 2])
    name = setting.name
    while flag(name) in [s.flag for s in known]:
        letters = list(setting.name)
        at = draw.randrange(1, len(letters) - 1)
        letters[at : at + 2] = reversed(letters[at : at + 2])
        name = "".join(letters)
    return Mistake(setting.given("1", flag=flag(name)), flag(name))


def no_value(draw: random.Random, known: Sequence[Setting]) -> Mistake:
    """Nothing follows the name."""
    setting = draw.choice([s for s in known if s.kind is not bool])
    return Mistake(setting.given(), setting.flag)


def wrong_kind(draw: random.Random, known: Sequence[Setting]) -> Mistake:
    """A word, or a fraction where it must be whole."""
    setting = draw.choice([s for s in known if s.kind in (int, float)])
    values = ["many", "1,000", "0x", "--"] + ["1.5", "1e3"] * (setting.kind is int)
    return Mistake(setting.given(draw.choice(values)), setting.flag)


def impossible(draw: random.Random, known: Sequence[Setting]) -> Mistake:
    """A number below or above all that can be."""
    setting = draw.choice([s for s in known if s.kind in (int, float)])
    values = ["99999999999", "-1"] if setting.kind is int else ["-0.5", "1e39"]
    return Mistake(setting.given(draw.choice(values)), setting.flag)


def not_finite(draw: random.Random, known: Sequence[Setting]) -> Mistake:
    """NaN or infinity."""
    setting = draw.choice([s for s in known if s.kind is float])
    return Mistake(setting.given(draw.choice(["nan", "inf", "-inf"])), setting.flag)


def wrong_choice(draw: random.Random, known: Sequence[Setting]) -> Mistake:
    """None of the words that it may be."""
    kinds = [s for s in known if typing.get_origin(s.kind) is typing.Literal]
    kinds += [s for s in known if s.name in ("method", "profile", "backend")]
    setting = draw.choice(kinds)
    return Mistake(setting.given("sideways"), "sideways")


def library(draw: random.Random, known: Sequence[Setting]) -> Mistake:
    """A value of another type, in Python."""
    mine = [s for s in known if s.method in ("ft1", "rewire")]
    setting = draw.choice([s for s in mine if s.kind in (int, float, str)])
    value: Any = draw.choice([None, [1], "3", {}, True, float("nan")])
    if setting.kind is str:
        value = draw.choice([None, 3, ["rewire"]])
    call = json.dumps([setting.name, value, "{out}"]).replace("{}", "{{}}")
    return Mistake(("-c", call), setting.name.replace("_", "-"))


_MAKERS: tuple[Callable[[random.Random, Sequence[Setting]], Mistake], ...] = (
    misspelt,
    no_value,
    wrong_kind,
    impossible,
    not_finite,
    wrong_choice,
    library,
)


def generated(seed: int, count: int) -> list[tuple[str, Mistake]]:
    """Names of makers, and what they made."""
    draw, known = random.Random(seed), list(settings())
    makers = [_MAKERS[n % len(_MAKERS)] for n in range(count)]
    return [(make.__name__, make(draw, known)) for make in makers]


def _sweep(*words: str) -> tuple[str, ...]:
    return ("sweep", *TRAIN[1:], "--out", "{out}", *words)


def _train(*words: str) -> tuple[str, ...]:
    return (*TRAIN, "--out", "{out}", *words)


# Each makes sense alone; and what other commands take.
_CONTRADICTORY = (
    Mistake(_train("--scenario", "ant/transfer"), "--scenario"),
    Mistake(_train("--backend", "mjx"), "--backend"),
    Mistake(_train("--modes", "5", "--mode-slots", "3"), "--mode-slots"),
    Mistake(_train("--warmup", "640"), "--warmup"),
    Mistake(_train("--buffer", "8"), "--buffer"),
    Mistake(
        _train("--buffer", _MANY, "--interactions", _MANY, "--seeds", "500"), "--buffer"
    ),
    Mistake(_train("--hidden", _MANY), "--hidden"),
    Mistake(_train("--tasks", "5"), "--tasks"),
    Mistake(_train("--overlap"), "--overlap"),
    Mistake(_train("--keep", "0.5"), "--keep"),
    Mistake(_train("--log", "paper"), "paper"),
    Mistake(_train("surplus"), "surplus"),
    Mistake(("train", "probe/reech", *TRAIN[2:], "--out", "{out}"), "probe/reach"),
    Mistake(TRAIN, "--out"),
    Mistake(_sweep(), "axis"),
    Mistake(_sweep("--k"), "modes"),
    Mistake(_sweep("--axis", "betta", "1", "2"), "betta"),
    Mistake(_sweep("--axis", "hidden", "8", "16"), "hidden"),
    Mistake(_sweep("--beta", "1", "x"), "beta"),
    Mistake(_sweep("--beta", "1", "1"), "same"),
    Mistake(_sweep("--beta", "-1", "1"), "--beta"),
    Mistake(_sweep("--k", "1.5"), "--modes"),
    Mistake(_sweep("--beta", "1", "2", "--halving", "0"), "--halving"),
    Mistake(_sweep("--beta", "2", "1", "--random", "4"), "--beta"),
    Mistake(_sweep("--beta", "1", "--beta", "2"), "beta"),
    Mistake(("info", "probe/reech"), "probe/reach"),
    Mistake(("report", "--out", "{out}"), "folder"),
    Mistake(("evaluate", "{out}", "--episodes", "none"), "--episodes"),
    Mistake(("evaluate",), "run"),
)


def made(mistake: Mistake, place: Path) -> Outcome:
    """Makes a mistake: one line names it, and nothing is compiled or left behind."""
    out, cache = place / "out", place / "cache"
    words = [word.format(out=out) for word in mistake.words]
    if words[0] == "-c":
        command = [sys.executable, "-c", _CALL, *words[1:]]
        ran = base.execute(command, JAX_COMPILATION_CACHE_DIR=str(cache))
        wrong = base.complaint(ran, mistake.named, status=1)
    else:
        ran = base.run(*words, "--cache", cache)
        wrong = base.complaint(ran, mistake.named)
    left = "the folder is there" if out.exists() else ""
    compiled = [path.name for path in cache.glob("jit_*-cache")]
    return Outcome(ran.said, base.first(wrong, left, _training(compiled)), 0)


def _training(compiled: Sequence[str]) -> str:
    """Says so if a function that trains or plays was compiled."""
    some = [name for name in compiled if name.startswith(("jit_chunk", "jit_begin"))]
    return f"compiled: {some}" if some else ""


KINDS = (
    Kind(
        "mistake",
        "settings or arguments that make no sense",
        (
            *(
                Case(f"{maker} {' '.join(mistake.words)}", partial(made, mistake))
                for maker, mistake in generated(_SEED, 50)
            ),
            *(
                Case(" ".join(mistake.words), partial(made, mistake))
                for mistake in _CONTRADICTORY
            ),
        ),
    ),
)
