"""The domains by name: what a scenario's tasks are variations of."""

import difflib
from collections.abc import Callable, Sequence
from typing import NamedTuple

from rewire_jax.core.arguments import check_name
from rewire_jax.core.errors import UserError
from rewire_jax.envs import metaworld, probe
from rewire_jax.envs.base import Domain, TaskChange
from rewire_jax.envs.task_parameters import check_names


class DomainKind(NamedTuple):
    """How a domain is made.

    Attributes:
      make: `(name, changes, backend, reward) -> Domain`; the changes are those of a
        scenario's tasks.
      backend: the default backend; "probe" and "own" mark domains that have one
        backend only.
    """

    make: Callable[[str, Sequence[TaskChange], str, str], Domain]
    backend: str


BRAX_BACKENDS = ("v1", "positional", "spring", "generalized", "mjx")


def _make_brax(
    name: str, changes: Sequence[TaskChange], backend: str, reward: str
) -> Domain:
    check_names("Brax backend", [backend], BRAX_BACKENDS)
    # Brax takes seconds to import, and most commands do not need it.
    if backend == "v1":
        from rewire_jax.envs import brax_v1

        return brax_v1.make_domain(name)
    from rewire_jax.envs import brax

    return brax.make_domain(name, backend)


def _make_metaworld(
    name: str, changes: Sequence[TaskChange], backend: str, reward: str
) -> Domain:
    tasks = dict.fromkeys(str(change.extra.get("task")) for change in changes)
    return metaworld.make_domain(backend, reward, tuple(tasks))


def _make_probe(
    name: str, changes: Sequence[TaskChange], backend: str, reward: str
) -> Domain:
    return probe.make_domain(name)


DOMAINS: dict[str, DomainKind] = {
    "halfcheetah": DomainKind(_make_brax, "v1"),
    "ant": DomainKind(_make_brax, "v1"),
    "humanoid": DomainKind(_make_brax, "v1"),
    "metaworld": DomainKind(_make_metaworld, "mujoco"),
    **dict.fromkeys(probe.NAMES, DomainKind(_make_probe, "probe")),
}


def register_domain(name: str, domain: Domain) -> None:
    """Registers a domain for specs to name; it replaces your own of the same name.

    Raises:
      UserError: it would replace a domain of this package, or an argument is of a wrong
        kind.
    """
    check_name("domain", name)
    if not isinstance(domain, Domain):
        raise UserError(f"domain {name!r} must be a Domain, not {domain!r:.80}")
    if name in DOMAINS and DOMAINS[name].backend != "own":
        raise UserError(f"there is a domain named {name!r}: choose another name")
    DOMAINS[name] = DomainKind(lambda *_: domain, "own")


def unknown(kind: str, name: str, known: list[str]) -> str:
    """The message for a name that is not known."""
    close = difflib.get_close_matches(name, known, n=3)
    hint = f" Did you mean {' or '.join(close)}?" if close else ""
    return f"Unknown {kind} {name!r}.{hint} Known: {', '.join(sorted(known))}."
