"""Generated parts of the pages: each replaces a `<!-- made: NAME ARGUMENT -->`."""

import contextlib
import dataclasses
import importlib
import inspect
import io
import re
import subprocess
import sys
import typing
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import docstring_parser
import tyro

import rewire_jax
from experiments import suite
from rewire_jax.cli import main
from rewire_jax.cli.commands import COMMANDS
from rewire_jax.cli.flags import Flags
from rewire_jax.core.arguments import flag
from rewire_jax.core.settings import SacSettings, Settings, traced_fields
from rewire_jax.methods import METHODS
from rewire_jax.reports.table import to_markdown

ROOT = Path(__file__).resolve().parent.parent
_EXAMPLE = "halfcheetah/forgetting"


def fill(app: Any, page: str, source: list[str]) -> None:
    """Handles Sphinx's event `source-read`: fills in the generated parts of a page."""
    del app, page
    source[0] = re.sub(
        r"<!-- made: (\w+) ?(\S*) -->", lambda m: MADE[m[1]](m[2]), source[0]
    )


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(to_markdown(heads, rows)).strip()


class Item(typing.NamedTuple):
    """An argument or a setting, with the description from its class."""

    name: str
    kind: Any
    default: Any
    meaning: str


def items(cls: type) -> Iterator[Item]:
    """The fields of a dataclass that tyro turns into arguments."""
    meanings: dict[str, str] = {}
    for each in reversed(cls.__mro__):
        for said in docstring_parser.parse(each.__doc__ or "").params:
            meanings[said.arg_name] = " ".join((said.description or "").split())
    hints = typing.get_type_hints(cls, include_extras=True)
    for field in dataclasses.fields(cls):
        kind = hints[field.name]
        if tyro.conf.Suppress not in getattr(kind, "__metadata__", ()):
            meaning = meanings[field.name]
            yield Item(field.name, kind, field.default, meaning)


def said(marks: Sequence[Any], what: str) -> str | None:
    """What an argument's marks for tyro say, for example its `name`."""
    return next((x for x in (getattr(m, what, None) for m in marks) if x), None)


def values(kind: Any) -> str:
    """The type of an argument in a word, or its choices."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return said(inner[1:], "metavar") or values(inner[0])
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in inner)
    if origin in (Union, type(int | None)):
        return values(inner[0])
    if origin is tuple:
        return f"{values(inner[0])}, several"
    return {bool: "yes or no", str: "text", Path: "path"}.get(kind, kind.__name__)


def shown(value: Any) -> str:
    """A value as the user types it; empty if there is none."""
    if value is None or value is dataclasses.MISSING or value == ():
        return ""
    if isinstance(value, tuple):
        return " ".join(shown(each) for each in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def argument(item: Item) -> str:
    """The flag, or the name of a positional argument."""
    marks = getattr(item.kind, "__metadata__", ())
    placed = tyro.conf.Positional in marks
    name = said(marks, "name") or item.name
    return f"`{name.upper() if placed else flag(name)}`"


def arguments(cls: type, besides: type | None = None) -> str:
    """A table of a command's arguments, without a run's settings and `besides`."""
    told = {"settings", *getattr(besides, "__dataclass_fields__", ())}
    return table(
        ["argument", "values", "default", "meaning"],
        [
            [argument(item), values(item.kind), shown(item.default), item.meaning]
            for item in items(cls)
            if item.name not in told
        ],
    )


def prose(thing: Any) -> str:
    """A docstring up to its first section, with flags as code."""
    said = re.split(r"\n\n(?:Attributes|Raises):", inspect.getdoc(thing) or "")[0]
    return re.sub(r"(?<![`\w-])--[a-z][a-z0-9-]*", r"`\g<0>`", said)


def usage(_: str) -> str:
    """What `rewire-jax --help` prints."""
    shown = io.StringIO()
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(shown):
        main.main(["--help"])
    return f"```text\n{shown.getvalue().strip()}\n```"


def commands(_: str) -> str:
    """Each command of `rewire-jax`, from its dataclass in `cli`."""
    parts = []
    for name, cls in COMMANDS.items():
        needs = " SCENARIO" if "settings" in cls.__annotations__ else ""
        parts += [f"## `rewire-jax {name}{needs}`", prose(cls), arguments(cls, Flags)]
        if needs:
            parts += ["And [the settings of a run](settings.md), as flags."]
    return "\n\n".join(parts)


def experiments(_: str) -> str:
    """Each script in experiments that takes arguments."""
    parts = []
    for path in sorted((ROOT / "experiments").glob("*.py")):
        if "suite.command(" not in path.read_text() or path.stem == "suite":
            continue
        module = importlib.import_module(f"experiments.{path.stem}")
        (job, *_rest) = typing.get_type_hints(module.run).values()
        parts += [f"## `python -m experiments.{path.stem}`", prose(module)]
        parts += [arguments(job)]
    return "\n\n".join(parts)


def targets(_: str) -> str:
    """The Makefile's targets, as `make help` lists them."""
    found = re.findall(r"^([a-z-]+):.*## (.*)", (ROOT / "Makefile").read_text(), re.M)
    return table(
        ["command", "what it does"], [[f"`make {name}`", said] for name, said in found]
    )


def settings(which: str) -> str:
    """A table of settings: of a run, of SAC, or of a method by its name."""
    presets = {
        profile: rewire_jax.preset(
            rewire_jax.make_scenario(_EXAMPLE),
            which if which in METHODS else "rewire",
            profile,
        )
        for profile in ("paper", "quick")
    }
    parts = {"run": Settings, "sac": SacSettings}
    cls = parts.get(which) or METHODS[which].settings
    if which == "sac":
        chosen: list[Any] = [preset.sac for preset in presets.values()]
    else:
        chosen = [p if which == "run" else p.options for p in presets.values()]
    traced = traced_fields(cls)
    return table(
        ["setting", "values", "paper", "quick", "axis", "meaning"],
        [
            [
                argument(item),
                values(item.kind),
                *(shown(getattr(each, item.name)) for each in chosen),
                "yes" if item.name in traced else "",
                item.meaning,
            ]
            for item in items(cls)
            if item.name not in ("sac", "options")
        ],
    )


def methods(_: str) -> str:
    """The settings of every method that has any."""
    named: dict[type, list[str]] = {}
    for name, entry in METHODS.items():
        named.setdefault(entry.settings, []).append(name)
    parts = []
    for cls, names in named.items():
        parts += ["## " + ", ".join(f"`{name}`" for name in names)]
        some = dataclasses.fields(cls)
        parts += [settings(names[0]) if some else prose(cls)]
        for other in names[1:] if some else ():
            parts += [f"`{other}` has other values in the paper profile:"]
            parts += [differing(names[0], other)]
    return "\n\n".join(parts)


def differing(one: str, other: str) -> str:
    """The settings in which two methods of one class differ."""
    scenario = rewire_jax.make_scenario(_EXAMPLE)
    first, second = (
        vars(rewire_jax.preset(scenario, each).options) for each in (one, other)
    )
    rows = [
        [f"`{flag(name)}`", shown(value), shown(second[name])]
        for name, value in first.items()
        if value != second[name]
    ]
    return table(["setting", f"`{one}`", f"`{other}`"], rows)


def by_scenario(_: str) -> str:
    """Settings of the paper profile that differ between scenarios."""
    known = [rewire_jax.make_scenario(name) for name in rewire_jax.list_scenarios()]
    parts = []
    for title, method, part in (
        ("A run", "rewire", None),
        ("SAC", "rewire", "sac"),
        *((f"`{name}`", name, "options") for name in METHODS),
    ):
        rows: dict[str, dict[str, Any]] = {}
        for scenario in known:
            preset = rewire_jax.preset(scenario, method)
            rows[scenario.name] = vars(getattr(preset, part) if part else preset)
        first, *others = rows.values()
        names = [
            name
            for name in first
            if name not in ("scenario", "paper_interactions", "sac", "options")
            and any(first[name] != other[name] for other in others)
        ]
        same: dict[tuple[str, ...], list[str]] = {}
        for at, row in rows.items():
            same.setdefault(tuple(shown(row[n]) for n in names), []).append(f"`{at}`")
        heads = ["scenarios", *(f"`{flag(name)}`" for name in names)]
        if names:
            lines = [[", ".join(at), *cells] for cells, at in same.items()]
            parts += [f"### {title}", table(heads, lines)]
    return "\n\n".join(parts)


def default(name: str) -> str:
    """A setting's default, and the profiles' values if they differ."""
    scenario = rewire_jax.make_scenario(_EXAMPLE)
    for method in METHODS:
        presets = [
            rewire_jax.preset(scenario, method, each) for each in ("paper", "quick")
        ]
        for part in ("", "sac", "options"):
            owners = [getattr(each, part) if part else each for each in presets]
            if name in vars(owners[0]):
                paper, quick = (shown(getattr(owner, name)) for owner in owners)
                own = shown(getattr(type(owners[0]), name, None))
                found = dict.fromkeys([own or paper, paper, quick])
                if len(found) == 1:
                    return paper
                return f"{own or 'none'}; paper {paper}, quick {quick}"
    raise KeyError(name)


def results(prefix: str) -> str:
    """The committed results whose names start with `prefix`, or a note."""
    parts = []
    for path in sorted((ROOT / suite.RESULTS).glob(f"{prefix}*")):
        pages = path.glob("*.md") if path.is_dir() else [path]
        parts += [
            f"````{{include}} ../{page.relative_to(ROOT).as_posix()}\n"
            ":relative-images:\n:heading-offset: 1\n````"
            for page in sorted(pages)
            if page.suffix == ".md"
        ]
    return "\n\n".join(parts) or "No result is committed yet."


def cases(file: str) -> str:
    """The tests in a file, and how many cases each has, as pytest collects them."""
    words = ["-m", "pytest", "--collect-only", "--quiet", file]
    found = subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=True
    )
    counts = Counter(re.findall(rf"^{file}::test_(\w+)", found.stdout, re.M))
    rows = [[name.replace("_", " "), str(count)] for name, count in counts.items()]
    return table(["test", "cases"], [*rows, ["all", str(counts.total())]])


def public(_: str) -> str:
    """Everything in `rewire_jax.__all__`, described from its docstring."""
    blocks = []
    for name in sorted(rewire_jax.__all__):
        value = getattr(rewire_jax, name)
        if inspect.isclass(value):
            blocks.append(f".. autoclass:: rewire_jax.{name}\n   :members:")
        else:
            kind = "function" if callable(value) else "data"
            blocks.append(f".. auto{kind}:: rewire_jax.{name}")
    return "```{eval-rst}\n" + "\n\n".join(blocks) + "\n```"


MADE: dict[str, Callable[[str], str]] = {
    each.__name__: each
    for each in (
        by_scenario,
        cases,
        commands,
        default,
        experiments,
        methods,
        public,
        results,
        settings,
        targets,
        usage,
    )
}
