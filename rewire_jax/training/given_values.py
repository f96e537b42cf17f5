"""Values that a caller gives in place of those of complete settings."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.arguments import flag, require
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import (
    SacSettings,
    Settings,
    traced_fields,
    validate,
    with_traced,
)


def with_values(
    settings: Settings, sac: SacSettings | None, options: Any
) -> tuple[SacSettings, Any]:
    """Returns settings of SAC and of the method with the traced values of others.

    Args:
      settings: checked and complete.
      sac: SAC's settings with the wanted values; None for the given ones.
      options: the method's settings, in the same way.

    Raises:
      UserError: another class, or an invalid value. What JAX traces is not checked.
    """
    known = {
        "sac": _known(settings.sac, sac, "sac"),
        "options": _known(settings.options, options, "options"),
    }
    validate(dataclasses.replace(settings, **known))
    known["options"].checked()
    return (
        with_traced(settings.sac, settings.sac if sac is None else sac),
        with_traced(settings.options, settings.options if options is None else options),
    )


def _known(own: Any, given: Any, name: str) -> Any:
    """Settings with the values of others, apart from those that JAX traces.

    Args:
      own: checked and complete settings of SAC or of the method.
      given: settings with the wanted values; None for the own ones.
      name: name of the argument.

    Raises:
      UserError: another class, a static value that differs, or a value that is no
        single number.
    """
    if given is None:
        return own
    kind = type(own)
    if not isinstance(given, kind):
        raise UserError(f"{name} must be a {kind.__name__}, not {given!r:.80}")
    values = {}
    for field in dataclasses.fields(kind):
        value, before = getattr(given, field.name), getattr(own, field.name)
        if field.name not in traced_fields(kind):
            # Zero is what `checked` fills in.
            fixed = not isinstance(value, jax.core.Tracer)
            same = fixed and (value == before or value == field.default == 0)
            require(same, f"{flag(field.name)} cannot differ from {before} here")
            continue
        shape = np.shape(value)
        require(not shape, f"{flag(field.name)} has the shape {shape}: use jax.vmap")
        if not isinstance(value, jax.core.Tracer):
            values[field.name] = value.item() if hasattr(value, "item") else value
        elif not jnp.issubdtype(value.dtype, jnp.floating):
            whole = jnp.issubdtype(value.dtype, jnp.integer)
            require(whole, f"{flag(field.name)} must be a number, not {value.dtype}")
    return dataclasses.replace(own, **values)
