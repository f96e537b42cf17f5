"""The members of a population (configurations × seeds), and their devices."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from rewire_jax.core import kept_programs
from rewire_jax.core.settings import SacSettings, Settings

_AXIS = "members"
_LONGEST = 1_000  # bytes of a message between processes


class Member(NamedTuple):
    """One member.

    Attributes:
      number: number in the run or sweep.
      name: a label for the user.
      seed: determines all its randomness.
      sac: SAC's settings.
      options: the method's settings.
    """

    number: int
    name: str
    seed: int
    sac: SacSettings
    options: Any


class Members(NamedTuple):
    """The values that differ between members; every leaf is `[members]`.

    Attributes:
      keys: random keys, made only from the seeds.
      sac: SAC's settings.
      options: the method's settings.
    """

    keys: jax.Array
    sac: SacSettings
    options: Any


def cross(
    configurations: Sequence[tuple[SacSettings, Any]], seeds: Sequence[int]
) -> tuple[Member, ...]:
    """Every configuration with every seed; the seeds of one are consecutive."""
    pairs = [(pair, seed) for pair in configurations for seed in seeds]
    return tuple(
        Member(number, f"seed {seed}", seed, *pair)
        for number, (pair, seed) in enumerate(pairs)
    )


def of_run(settings: Settings) -> tuple[Member, ...]:
    """The members of a run, one for each seed."""
    seeds = range(settings.seed, settings.seed + settings.seeds)
    return cross([(settings.sac, settings.options)], seeds)


_make_keys = jax.jit(jax.vmap(jax.random.key))


def stack(members: Sequence[Member]) -> Members:
    """Stacks members; they may differ only in their traced numbers."""

    def stacked(settings):
        return jax.tree.map(
            lambda *leaves: np.asarray(leaves, jnp.result_type(*leaves)), *settings
        )

    return Members(
        keys=_make_keys(np.array([member.seed for member in members], np.uint32)),
        sac=stacked([member.sac for member in members]),
        options=stacked([member.options for member in members]),
    )


def mesh(members: int) -> Mesh:
    """The largest number of this process's devices that divides the members equally."""
    devices = jax.local_devices()
    number = next(n for n in range(len(devices), 0, -1) if members % n == 0)
    return Mesh(devices[:number], (_AXIS,))


class Traces:
    """Counts how often functions are traced; each should be traced once."""

    def __init__(self) -> None:
        self.count = 0

    def of(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with its traces counted."""

        @functools.wraps(function)
        def counted(*arguments: Any) -> Any:
            self.count += 1
            return function(*arguments)

        return counted


def place(tree: Any, mesh: Mesh) -> Any:
    """Spreads a pytree with a leading axis `[members]` over the devices."""
    return jax.device_put(tree, NamedSharding(mesh, P(_AXIS)))


def compiled(
    function: Callable[..., Any],
    axes: Sequence[int | None],
    mesh: Mesh,
    donate: tuple[int, ...] = (),
    name: str = "",
    traces: Traces | None = None,
) -> Callable[..., Any]:
    """A function of whole populations, compiled at its first call.

    Each device computes its own members; devices do not communicate.

    Args:
      function: arguments and results have a leading axis `[members]`.
      axes: for each argument 0, or None if all members share it.
      mesh: the devices.
      donate: arguments whose memory the result may reuse.
      name: what it computes, if its program may be kept for later processes.
      traces: counts how often it is traced.
    """
    shares = tuple(P() if axis is None else P(_AXIS) for axis in axes)
    # Members vary over devices and counters do not, and loops carry both.
    local = jax.shard_map(
        function, mesh=mesh, in_specs=shares, out_specs=P(_AXIS), check_vma=False
    )
    # Needed for one device, too. Without it, a function's results and the arrays from
    # `place` have different shardings, and a function is traced once for each.
    by_member = NamedSharding(mesh, P(_AXIS))

    def jitted(function: Callable[..., Any]) -> Callable[..., Any]:
        counted = traces.of(function) if traces else function
        return jax.jit(counted, donate_argnums=donate, out_shardings=by_member)

    # A kept program is one for a single device.
    if name and mesh.size == 1:
        return kept_programs.kept(local, name, jitted)
    return jitted(local)


def over(
    mesh: Mesh,
    function: Callable[..., Any],
    *axes: int | None,
    donate: tuple[int, ...] = (),
    name: str = "",
    traces: Traces | None = None,
) -> Callable[..., Any]:
    """Turns a function of one member into one of populations, see `compiled`."""
    return compiled(jax.vmap(function, axes), axes, mesh, donate, name, traces)
