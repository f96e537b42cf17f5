"""The methods by name."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rewire_jax.core import kept_programs
from rewire_jax.core.arguments import check_name
from rewire_jax.core.errors import UserError
from rewire_jax.methods import (
    cka,
    clonex,
    csp_settings,
    finetune,
    packnet,
    pnn,
    regularization,
    reset_distill,
    rewire_settings,
    segments,
)
from rewire_jax.methods.base import Method
from rewire_jax.methods.csp import csp
from rewire_jax.methods.rewire import rewire
from rewire_jax.methods.spec import Spec


class Entry(NamedTuple):
    """How a method is made.

    Attributes:
      make: `(spec, settings) -> Method`.
      settings: its settings class, made with `settings`; `checked()` gives
        settings ready to use or raises `UserError`.
      preset: `(scenario name, period, profile) -> settings`; tasks recur after
        `period` places.
      selection_episodes: default number of episodes of each candidate; None for the
        profile's value.
      together: returns the settings of a population's members with equal static
        values.
    """

    make: Callable[[Spec, Any], Method]
    settings: type
    preset: Callable[[str, int, str], Any]
    selection_episodes: int | None = None
    together: Callable[[Sequence[Any]], list[Any]] = list

    def build(self, spec: Spec, options: Any) -> Method:
        """The method for the tasks or segments of a run, see `segments.build`."""
        return segments.build(self.make, spec, options)


# Those of the paper in the order of its Table 1, then others.
METHODS: dict[str, Entry] = {
    "ft1": Entry(finetune.ft1, finetune.FinetuneSettings, finetune.preset),
    "ft_l2": Entry(
        regularization.ft_l2, regularization.FtL2Settings, regularization.preset_ft_l2
    ),
    "packnet": Entry(packnet.packnet, packnet.PackNetSettings, packnet.preset),
    "ewc": Entry(
        regularization.ewc, regularization.EwcSettings, regularization.preset_ewc
    ),
    "pnn": Entry(pnn.pnn, pnn.PnnSettings, pnn.preset),
    "sac_n": Entry(finetune.sac_n, finetune.FinetuneSettings, finetune.preset),
    "ft_n": Entry(finetune.ft_n, finetune.FinetuneSettings, finetune.preset),
    "csp": Entry(
        csp, csp_settings.CspSettings, csp_settings.preset, selection_episodes=1
    ),
    "rewire": Entry(
        rewire,
        rewire_settings.RewireSettings,
        rewire_settings.preset,
        together=rewire_settings.together,
    ),
    "rewire_tuned": Entry(
        rewire,
        rewire_settings.RewireSettings,
        rewire_settings.preset_tuned,
        together=rewire_settings.together,
    ),
    "cka": Entry(cka.cka, cka.CkaSettings, cka.preset),
    "clonex": Entry(
        clonex.clonex, clonex.ClonexSettings, clonex.preset, selection_episodes=1
    ),
    "reset_distill": Entry(
        reset_distill.reset_distill,
        reset_distill.ResetDistillSettings,
        reset_distill.preset,
    ),
}


# A function that two entries share has the first one's name.
for _name, _entry in reversed(METHODS.items()):
    kept_programs.give_name(_name, _entry.make)


def register_method(name: str, entry: Entry) -> None:
    """Adds your own method; use it by its name, like the others.

    Raises:
      UserError: another method has that name, or an argument is of a wrong kind.
    """
    check_name("method", name)
    if not isinstance(entry, Entry):
        raise UserError(f"method {name!r} must be an Entry, not {entry!r:.80}")
    if METHODS.get(name, entry) != entry:
        raise UserError(f"there is another method named {name!r}: choose another name")
    METHODS[name] = entry


def find_method(name: str) -> Entry:
    """The method of that name; `UserError` if there is none."""
    if not isinstance(name, str) or name not in METHODS:
        raise UserError(
            f"unknown method {name!r}: choose one of {', '.join(sorted(METHODS))}"
        )
    return METHODS[name]
