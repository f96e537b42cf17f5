"""A campaign's TOML file: configurations and the seeds to train them with.

title = "Two methods on the probe"
tuned_on = ["probe/reach"]      # scenarios that any setting was tuned on
population = "auto"             # or "always", "never"

[[runs]]
scenarios = ["probe/reach"]
methods = ["rewire"]
seeds = 3                       # 0, 1 and 2; or a list
priority = 1                    # smaller ones are trained first; 0 by default
profile = "quick"               # and backend
name = "rewire, one mode"       # of the configuration; the method's by default
[runs.settings]                 # flags of `rewire-jax train`
modes = 1

[submit]                        # parameters of submitit's executor
slurm_partition = "gpu"
"""

import dataclasses
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from rewire_jax.core.arguments import flag, require
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import MOST_SEEDS, Settings, validate
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.storage.json_lines import raw
from rewire_jax.training.presets import preset
from rewire_jax.training.run_setup import prepare

Population = Literal["auto", "always", "never"]
_KEYS: dict[str, type | tuple[type, ...]] = {
    "title": str,
    "tuned_on": list,
    "population": str,
    "submit": dict,
    "runs": list,
}
_RUN_KEYS: dict[str, type | tuple[type, ...]] = {
    "scenarios": list,
    "methods": list,
    "seeds": (int, list),
    "priority": int,
    "profile": str,
    "backend": str,
    "name": str,
    "settings": dict,
}
_LONGEST_NAME = 100  # letters: it names a folder
# What an entry says in other words, or what a run derives.
_NOT_SET = "scenario", "method", "profile", "backend", "seed", "seeds"
_DERIVED = "paper_interactions", "sac", "options"


@dataclass(frozen=True, kw_only=True)
class PlannedRun:
    """A configuration with one seed, or with several as a population.

    Attributes:
      configuration: name of the configuration.
      settings: complete settings, with the seeds.
      flags: values of flags of `rewire-jax train`, by setting.
      priority: runs with smaller numbers are trained first.
      turn: place of the seed among those of its configuration.
    """

    configuration: str
    settings: Settings
    flags: Mapping[str, Any]
    priority: int
    turn: int

    @property
    def seeds(self) -> range:
        """Its seeds."""
        return range(self.settings.seed, self.settings.seed + self.settings.seeds)

    @property
    def name(self) -> str:
        """Name of the run, and path of its folder in the campaign's folder."""
        last = f"-{self.seeds[-1]}" if len(self.seeds) > 1 else ""
        plural = "seeds" if last else "seed"
        folder = slug(self.configuration)
        return f"{self.settings.scenario}/{folder}/{plural}-{self.seeds[0]}{last}"

    def words(self, **changed: Any) -> list[str]:
        """The command line that trains it, without `--out`; some settings changed."""
        seeds = {"seed": self.settings.seed, "seeds": self.settings.seeds}
        flags = {**self.flags, **seeds, **changed}
        words = ["train", self.settings.scenario]
        return words + [word for name in flags for word in _words(name, flags[name])]


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """A campaign, as its file says.

    Attributes:
      path: the file.
      title: title of the page.
      tuned_on: scenarios that any setting was tuned on; None if the file does not say.
      population: whether the seeds of a configuration are trained as a population.
      submit: parameters of submitit's executor.
      runs: a run for each configuration and seed, in the order of training.
    """

    path: Path
    title: str
    tuned_on: tuple[str, ...] | None
    population: Population
    submit: Mapping[str, Any]
    runs: tuple[PlannedRun, ...]


def slug(name: str) -> str:
    """The name of a configuration as the name of a folder."""
    return re.sub(r"[^a-z0-9.+_]+", "-", name.lower()).strip("-.")


def read_campaign(file: str | Path) -> Campaign:
    """Reads a campaign's file and checks every configuration; trains nothing.

    Raises:
      UserError: the file cannot be read, or something in it is wrong; the message says
        where.
    """
    path = Path(file)
    if not path.exists():
        raise UserError(f"{path} does not exist: name the file of a campaign")
    with _at(str(path)):
        try:
            text = raw(path).decode()
            data = tomllib.loads(text)
        except (ValueError, RecursionError) as error:  # of TOML or of UTF-8
            raise UserError(f"it is not TOML: {error}") from error
        _check(data, _KEYS)
        require(bool(data.get("runs")), "it has no [[runs]]")
        population = data.get("population", "auto")
        known = get_args(Population)
        choices = f"choose one of {', '.join(known)}"
        require(population in known, f"population {population!r}: {choices}")
        tuned_on = data.get("tuned_on")
        for scenario in tuned_on or ():
            make_scenario(str(scenario))
    lines = [
        number
        for number, line in enumerate(text.splitlines(), 1)
        if re.match(r"\s*\[\[\s*runs\s*\]\]", line)
    ]
    seen: dict[str, PlannedRun] = {}
    for number, entry in enumerate(data["runs"]):
        line = f", line {lines[number]}" if number < len(lines) else ""
        with _at(f"{path}{line}, [[runs]] number {number + 1}"):
            for run in _runs(entry):
                _add(run, seen)
    runs = sorted(seen.values(), key=lambda run: (run.priority, run.turn))
    return Campaign(
        path=path,
        title=data.get("title", path.stem),
        tuned_on=None if tuned_on is None else tuple(tuned_on),
        population=population,
        submit=data.get("submit", {}),
        runs=tuple(runs),
    )


def as_populations(runs: Sequence[PlannedRun]) -> list[PlannedRun]:
    """The same training with consecutive seeds of a configuration as one run."""
    made: dict[tuple[str, str, int, int, int], PlannedRun] = {}
    for run in sorted(runs, key=lambda run: run.settings.seed):
        # Seeds minus turns are equal where seeds are consecutive.
        start = run.settings.seed - run.turn
        # Members of a population cannot notice changes of task each for itself.
        alone = run.settings.seed if run.settings.boundaries == "detected" else 0
        key = run.settings.scenario, run.configuration, run.priority, start, alone
        first = made.get(key)
        if first is None:
            made[key] = run
            continue
        grown = dataclasses.replace(first.settings, seeds=first.settings.seeds + 1)
        made[key] = dataclasses.replace(first, settings=grown)
    order = {run.configuration: place for place, run in reversed([*enumerate(runs)])}
    return sorted(made.values(), key=lambda r: (r.priority, order[r.configuration]))


@contextmanager
def _at(place: str) -> Iterator[None]:
    """A `UserError` inside also says where in the file it is."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{place}: {error}") from error


def _check(table: Any, keys: Mapping[str, type | tuple[type, ...]]) -> None:
    """Raises `UserError` if a table has an unknown key or a value of another type."""
    require(isinstance(table, dict), "it is not a table")
    for key, value in table.items():
        require(key in keys, f"unknown key {key!r}: choose from {', '.join(keys)}")
        # In Python a bool is an int, too.
        fits = isinstance(value, keys[key]) and not isinstance(value, bool)
        require(fits, f"{key} has a value of a wrong type: {value!r:.80}")


def _runs(entry: Any) -> Iterator[PlannedRun]:
    """The runs of an entry of the file."""
    _check(entry, _RUN_KEYS)
    for key in ("scenarios", "methods"):
        names = entry.get(key)
        words = bool(names) and all(isinstance(name, str) for name in names)
        require(words, f"{key} must be a list of names")
    seeds = entry.get("seeds", 1)
    if isinstance(seeds, int):
        require(seeds <= MOST_SEEDS, f"seeds must be at most {MOST_SEEDS}, not {seeds}")
        seeds = list(range(seeds))
    whole = all(type(seed) is int and seed >= 0 for seed in seeds)
    require(bool(seeds) and whole, "seeds must be a number, or a list of numbers")
    name, methods = entry.get("name"), entry["methods"]
    require(not name or len(methods) == 1, "name needs an entry with one method")
    for scenario in entry["scenarios"]:
        for method in methods:
            settings, flags = _settings(entry, scenario, method)
            validate(dataclasses.replace(settings, seed=max(seeds)))
            called = name or method
            require(bool(slug(called)), f"name {called!r} needs a letter or a digit")
            long = f"name {called[:20]!r}… is longer than {_LONGEST_NAME} letters"
            require(len(slug(called)) <= _LONGEST_NAME, long)
            for turn, seed in enumerate(seeds):
                yield PlannedRun(
                    configuration=called,
                    settings=dataclasses.replace(settings, seed=seed),
                    flags=flags,
                    priority=entry.get("priority", 0),
                    turn=turn,
                )


def _settings(
    entry: Mapping[str, Any], scenario: str, method: str
) -> tuple[Settings, dict[str, Any]]:
    """Complete settings of a configuration, and its flags."""
    given = {key: entry[key] for key in ("profile", "backend") if key in entry}
    table = entry.get("settings", {})
    values = {name.replace("-", "_"): value for name, value in table.items()}
    require(len(values) == len(table), "a setting is there twice, with - and with _")
    place = make_scenario(scenario, given.get("backend"), values.get("reward", "v2"))
    settings = preset(place, method, given.get("profile", "paper"))
    parts: dict[str, dict[str, Any]] = {"": {}, "sac": {}, "options": {}}
    for name, value in values.items():
        require(name not in _NOT_SET, f"{name} is not a setting: give it in [[runs]]")
        owners = {"": settings, "sac": settings.sac, "options": settings.options}
        found = [part for part, owner in owners.items() if name in vars(owner)]
        known = found and name not in _DERIVED
        require(bool(known), f"{method} on {scenario} has no setting {name!r}")
        parts[found[0]][name] = value
    settings = dataclasses.replace(
        settings,
        sac=dataclasses.replace(settings.sac, **parts["sac"]),
        options=dataclasses.replace(settings.options, **parts["options"]),
        **parts[""],
    )
    return prepare(settings, place).settings, {"method": method, **given, **values}


def _add(run: PlannedRun, seen: dict[str, PlannedRun]) -> None:
    """Adds a run to those before it.

    Raises:
      UserError: it is there already, or its configuration has other settings there.
    """
    folder = run.name.rpartition("/")[0]
    require(run.name not in seen, f"{run.name} is there twice")
    for other in seen.values():
        if other.name.rpartition("/")[0] == folder:
            same = run.flags == other.flags
            require(same, f"{folder} has other settings before: give it another name")
    seen[run.name] = run


def _words(name: str, value: Any) -> list[str]:
    if isinstance(value, bool):
        return [flag(name) if value else flag(f"no_{name}")]
    values = value if isinstance(value, list) else [value]
    return [flag(name), *map(str, values)]
