"""What a run's JSON holds: the fields of a header and of each table's rows."""

import sys
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from rewire_jax.core.settings import MOST_SEEDS

_LARGEST = sys.float_info.max  # so that neither NaN nor infinity is in any range
_NOUNS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


class Field(NamedTuple):
    """What a field holds.

    Attributes:
      kind: bool, int, float (also whole numbers) or str.
      least: smallest number.
      most: largest number.
      null: when it may be null instead: of a row marked as diverged, or of any row.
      needed: whether every row has it.
    """

    kind: type
    least: float = -_LARGEST
    most: float = _LARGEST
    null: Literal["never", "diverged", "always"] = "never"
    needed: bool = True


Fields = Mapping[str, Field]
"""Fields by name; `a.b` is `b` in the object `a`."""

_FLAG, _COUNT = Field(bool), Field(int, 0)
_SHARE = Field(float, 0, 1, "diverged", needed=False)
_OWNER = {"member": _COUNT, "seed": _COUNT}
_SOLVED = {"success": _SHARE, "success_last": _SHARE}


SETTINGS = {
    **dict.fromkeys(("scenario", "method", "profile", "backend"), Field(str)),
    "interactions": Field(int, 1),
    "seed": _COUNT,
    "seeds": Field(int, 1, MOST_SEEDS),
}
"""Of a header's settings: what reports need."""


SPEC = {"observations": Field(int, 1), "actions": Field(int, 1)}
"""Of a header's sizes: those that its settings do not determine."""


SWEEP = {"random": Field(int, 0), "halving": Field(int, 1)}
"""Of a sweep's header: what its caller asked for."""
HEADER = {"episode_length": Field(int, 1)}
"""Of a header: what reports need besides the settings."""


def results(tasks: int, stages: range) -> Fields:
    """Fields of `results.jsonl`, of so many tasks and of these stages."""
    return _OWNER | {
        "stage": Field(int, stages[0], stages[-1]),
        "task": Field(int, 0, tasks - 1),
        "name": Field(str),
        "episodes": Field(int, 1),
        "interactions.training": _COUNT,
        "interactions.selection": _COUNT,
        "diverged": _FLAG,
        "model_size": Field(float, 0),
        "stored_states": Field(float, 0, needed=False),
        "return": Field(float, null="diverged"),
        "choice": Field(float, null="diverged", needed=False),
        **_SOLVED,
    }


def training(stages: range) -> Fields:
    """Fields of `training.jsonl`; what else a row has are numbers, see `OTHERS`."""
    return _OWNER | {
        "stage": Field(int, stages[0], stages[-1]),
        "interactions": _COUNT,
        **{name: field._replace(null="always") for name, field in _SOLVED.items()},
    }


OTHERS = Field(float, null="always", needed=False)
"""A metric: null where it is not finite, or no episode ended."""


def timing(stages: range) -> Fields:
    """Fields of `timing.jsonl`."""
    return {
        "stage": Field(int, stages[0], stages[-1]),
        "interactions": _COUNT,
        "polishing": _COUNT._replace(needed=False),
        "seconds": Field(float, 0),
        "compile": _FLAG,
        "memory.process": _COUNT._replace(needed=False),
        "memory.device": _COUNT._replace(needed=False),
    }


def checked(
    row: Mapping[str, Any], fields: Fields, others: Field | None = None
) -> dict[str, Any]:
    """The values of an object by name, as in `Fields`.

    Args:
      row: the object, as read.
      fields: what it must hold.
      others: what all other fields must hold; None for anything.

    Raises:
      KeyError: it lacks a field.
      ValueError: a field holds something else.
    """
    flat: dict[str, Any] = {}
    for name, value in row.items():
        inner = value.items() if isinstance(value, dict) else ()
        flat |= {f"{name}.{key}": each for key, each in inner} or {name: value}
    for name in {**fields, **flat}:
        field = fields.get(name, others)
        if field and (field.needed or name in flat):
            _check(name, flat[name], field, flat.get("diverged") is True)
    return flat


def _check(name: str, value: Any, field: Field, diverged: bool) -> None:
    kind, least, most, null, _ = field
    if value is None and (null == "always" or (null == "diverged" and diverged)):
        return
    # In Python a bool is an int, too.
    fits = isinstance(value, bool) == (kind is bool) and isinstance(
        value, int | float if kind is float else kind
    )
    if not fits or not (kind is str or least <= value <= most):
        low, high = (
            f" {word} {limit:g}" if abs(limit) < _LARGEST else ""
            for word, limit in (("from", least), ("to", most))
        )
        raise ValueError(f"{name} is {value!r:.40}, not {_NOUNS[kind]}{low}{high}")
