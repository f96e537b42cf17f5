"""The configurations of a sweep: grids and random draws of numeric settings."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rewire_jax.core.arguments import flag, is_finite, is_real, require
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import (
    SacSettings,
    Settings,
    traced_fields,
    typed_settings,
    validate,
)
from rewire_jax.methods import find_method
from rewire_jax.training import population
from rewire_jax.training.population import Member

Values = dict[str, float]
"""Values of settings by name; `modes` is the paper's K."""
_DECADE = 10.0


def names(settings: Settings) -> dict[str, type]:
    """The settings that members of one population may differ in, and their types."""
    return traced_fields(SacSettings) | traced_fields(type(settings.options))


def read_axis(name: str, values: Any) -> list[float]:
    """The values of an axis.

    Raises:
      UserError: they are not a list of numbers.
    """
    several = isinstance(values, Iterable) and not isinstance(values, str)
    listed = list(values) if several else []
    fits = several and all(map(is_real, listed))
    require(fits, f"{flag(name)} needs a list of numbers, not {values!r:.80}")
    try:
        return [float(value) for value in listed]
    except OverflowError:
        raise UserError(f"{flag(name)} has a number that is too large") from None


def grid(axes: Mapping[str, Sequence[float]]) -> list[Values]:
    """Every combination of the axes' values, the last axis changing fastest."""
    return [
        dict(zip(axes, values, strict=True))
        for values in itertools.product(*axes.values())
    ]


def draws(
    axes: Mapping[str, Sequence[float]], number: int, settings: Settings
) -> list[Values]:
    """Random configurations, the same for the same seed in the settings.

    Args:
      axes: name and range (low, high) of each setting, or one fixed value. Whole-number
        settings get whole numbers, others log-uniform values if the range is positive
        and spans a factor of 10 or more, else uniform values.
      number: number of configurations.
      settings: settings of the sweep; they determine the seed and the types.

    Raises:
      UserError: an invalid range, or an unknown setting.
    """
    kinds = names(settings)
    for name, values in axes.items():
        for value in values:
            _check(name, value, kinds)
        require(
            len(values) == 1 or (len(values) == 2 and values[0] < values[1]),
            f"with --random, {flag(name)} needs a range, such as 0.1 10, or one value",
        )
    generator = np.random.default_rng(settings.seed)

    def draw(name: str) -> float:
        low, high = axes[name][0], axes[name][-1]
        if low == high:
            return low
        if kinds[name] is int:
            return int(generator.integers(int(low), int(high), endpoint=True))
        if low > 0 and high / low >= _DECADE:
            return math.exp(generator.uniform(math.log(low), math.log(high)))
        return generator.uniform(low, high)

    return [{name: draw(name) for name in axes} for _ in range(number)]


def configure(settings: Settings, values: Mapping[str, float]) -> Settings:
    """The settings with these values.

    Raises:
      UserError: an unknown setting, or an invalid value.
    """
    kinds = names(settings)
    sac: dict[str, Any] = {}
    options: dict[str, Any] = {}
    for name, value in values.items():
        _check(name, value, kinds)
        group = sac if hasattr(settings.sac, name) else options
        group[name] = kinds[name](value)
    settings = dataclasses.replace(
        settings,
        sac=dataclasses.replace(settings.sac, **sac),
        options=dataclasses.replace(settings.options, **options),
    )
    validate(settings)
    settings = typed_settings(settings)
    return dataclasses.replace(settings, options=settings.options.checked())


def read(member: Member, name: str) -> float:
    """A member's value of a setting."""
    return getattr(member.sac if hasattr(member.sac, name) else member.options, name)


def make_members(
    settings: Settings, configurations: Sequence[Mapping[str, float]]
) -> tuple[Settings, tuple[Member, ...]]:
    """The settings that a population shares, and its members."""
    same = {frozenset(values) for values in configurations}
    require(len(same) == 1, "all configurations need values for the same settings")
    variants = [configure(settings, values) for values in configurations]
    twice = len(variants) - len({(v.sac, v.options) for v in variants})
    require(not twice, f"{twice} of the configurations are the same as others")
    together = find_method(settings.method).together([v.options for v in variants])
    pairs = [(v.sac, options) for v, options in zip(variants, together, strict=True)]
    seeds = range(settings.seed, settings.seed + settings.seeds)
    members = tuple(
        member._replace(name=f"member {member.number}")
        for member in population.cross(pairs, seeds)
    )
    return dataclasses.replace(variants[0], options=together[0]), members


def describe(
    members: Sequence[Member], names: Sequence[str], seeds: int
) -> list[dict[str, Any]]:
    """What a sweep's header says of its members.

    Args:
      members: all members; the seeds of a configuration are consecutive.
      names: names of the settings in which they differ.
      seeds: number of seeds of each configuration.
    """
    return [
        {
            "member": member.number,
            "configuration": member.number // seeds,
            "seed": member.seed,
            "values": {name: read(member, name) for name in names},
        }
        for member in members
    ]


def values_of(members: Sequence[Mapping[str, Any]]) -> dict[str, list[float]]:
    """The values that each setting has among the members, in their order."""
    values: dict[str, list[float]] = {}
    for member in members:
        for name, value in member["values"].items():
            values.setdefault(name, [])
            if value not in values[name]:
                values[name].append(value)
    return values


def _check(name: str, value: float, kinds: Mapping[str, type]) -> None:
    require(
        name in kinds,
        f"no sweep over {name!r}: choose among {', '.join(sorted(kinds))}",
    )
    word = flag(name)
    require(is_real(value), f"{word} must be a number, not {value!r:.80}")
    require(is_finite(value), f"{word} must be finite, not {value}")
    require(
        kinds[name] is not int or value == int(value),
        f"{word} must be a whole number, not {value:g}",
    )
