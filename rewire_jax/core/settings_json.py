"""Settings as JSON, and their identity."""

import dataclasses
import hashlib
import json
from typing import Any, TypeVar

from rewire_jax.core.arguments import require
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import SacSettings, Settings, typed_settings, validate

T = TypeVar("T")


def to_json(run: Settings) -> dict[str, Any]:
    """The settings as a JSON-ready dictionary."""
    return dataclasses.asdict(run)


def digest(*settings: Any) -> str:
    """Identifies settings by their values; a new field with a default changes nothing.

    Args:
      settings: `Settings`, parts of them, or plain numbers.
    """

    def values(part: Any) -> Any:
        if not dataclasses.is_dataclass(part):
            return part
        return {
            field.name: values(value)
            for field in dataclasses.fields(part)
            if (value := getattr(part, field.name)) != field.default
        }

    text = json.dumps([values(part) for part in settings], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def from_json(data: dict[str, Any], options: type) -> Settings:
    """The settings that `to_json` wrote; `options` is the method's settings class.

    Raises:
      UserError: if a field is missing or unknown, or its value is invalid.
    """
    try:
        parts = {
            "sac": _filled(SacSettings, data["sac"]),
            "options": _filled(options, data["options"]),
        }
        run = _filled(Settings, data | parts)
    except (TypeError, KeyError, AttributeError) as error:
        raise UserError(f"its settings are damaged ({error})") from error
    validate(run)
    return typed_settings(run)


def _filled(cls: type[T], data: dict[str, Any]) -> T:
    """A settings class with the saved values; newer fields get their defaults."""
    fields = {field.name: field.default for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    unknown = ", ".join(sorted(data.keys() - fields.keys()))
    require(not unknown, f"it has the unknown setting {unknown}")
    lacking = [
        name
        for name, default in fields.items()
        if name not in data and default is dataclasses.MISSING
    ]
    require(not lacking, f"it has no setting {', '.join(lacking)}")
    return cls(**data)
