"""Policies of a finished or running run, as plain functions."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings, require
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Method, Spec
from rewire_jax.run import run_state, sweep
from rewire_jax.run.run_state import saved
from rewire_jax.run.sweep import Found
from rewire_jax.run.sweep_grid import configure
from rewire_jax.storage import run_folder

PolicyFunction = Callable[[jax.Array], jax.Array]
"""`[..., observations]` -> actions `[..., actions]` in [-1, 1]."""


class Learned(NamedTuple):
    """What a member has learned; its policies are made from nothing else.

    Attributes:
      params: what its method trains.
      method_state: what its method keeps from task to task; of `rewire`,
        `orders` `[slots, L, n]`, the cached wirings.
    """

    params: Any
    method_state: Any


class Policies(NamedTuple):
    """The policies of all members of a run: arrays, and one pure function of them.

    Attributes:
      act: `(member, task, observation) -> action` for a member's `Learned`, a `[]` int
        and `[..., observations]`; action `[..., actions]` in [-1, 1], without
        exploration. It can be jitted, and vmapped over members, tasks or both. It
        raises `AssertionError` for observations of another length.
      members: what all have learned, `[seeds]` on the leading axis of every leaf.
      seeds: of the members, in their order.
      tasks: names of the sequence.
    """

    act: Callable[[Learned, jax.Array | int, jax.Array], jax.Array]
    members: Learned
    seeds: tuple[int, ...]
    tasks: tuple[str, ...]


def load_policy(
    run: str | Path,
    *,
    task: int,
    seed: int | None = None,
    stage: int | None = None,
    member: int | None = None,
) -> PolicyFunction:
    """A learned policy as a pure function; nothing but the run's folder is needed.

    Args:
      run: folder of the run, or of a sweep.
      task: which task of the sequence to act in, from 0. A task not yet learned at
        that stage gets the latest policy.
      seed: of which member; the run's first if None.
      stage: as it was after this task's training; after the latest if None.
      member: of a sweep, in place of the seed; its number, as in members.csv.

    Returns:
      Observation `[..., observations]` (as the scenario's environment gives it) to
      action `[..., actions]`, without exploration. It can be jitted and vmapped. It
      raises `AssertionError` for observations of another length.

    Raises:
      UserError: no such run, task, seed, member or stage, or a damaged checkpoint.
    """
    folder = Path(run)
    kind = run_folder.kind(folder)
    header, settings, spec = _read(folder, kind)
    if not 0 <= task < spec.tasks:
        raise UserError(f"{folder} has tasks 0 to {spec.tasks - 1}, not {task}")
    if kind == "sweep":
        if member is None or seed is not None:
            raise UserError(
                f"{folder} holds a sweep: give member, a number in members.csv"
            )
        if not 0 <= member < len(header["members"]):
            raise UserError(f"{folder} has no member {member}: see members.csv there")
        found = sweep.find(folder, member, stage)
        settings = configure(settings, header["members"][member]["values"])
    else:
        if member is not None:
            raise UserError(f"{folder} holds a run: give seed, not member")
        seed = settings.seed if seed is None else seed
        found = Found(folder, stage, seed - settings.seed, settings.seeds)
        if not 0 <= found.place < found.num_slots:
            raise UserError(
                f"{folder} has no seed {seed}: see {run_folder.HEADER} there"
            )
    method = find_method(settings.method).make(spec, settings.options)
    learned = jax.tree.map(lambda leaf: leaf[found.place], _load(found, method))
    policy = method.policy(learned.params, learned.method_state, jnp.asarray(task))
    return functools.partial(_act, method, spec, policy)


def load_policies(run: str | Path, *, stage: int | None = None) -> Policies:
    """All policies of a run at once, to be vmapped over, compared and taken apart.

    Args:
      run: folder of the run.
      stage: as they were after this task's training; after the latest if None.

    Raises:
      UserError: no such run or stage, a sweep, or a damaged checkpoint.
    """
    folder = Path(run)
    require(
        run_folder.kind(folder) == "run",
        f"{folder} holds a sweep, whose members differ in settings: load_policy gives "
        "the policies of one",
    )
    header, settings, spec = _read(folder, "run")
    method = find_method(settings.method).make(spec, settings.options)

    def act(member: Learned, task: jax.Array | int, observation: jax.Array):
        policy = method.policy(member.params, member.method_state, jnp.asarray(task))
        return _act(method, spec, policy, observation)

    seeds = range(settings.seed, settings.seed + settings.seeds)
    members = _load(Found(folder, stage, 0, settings.seeds), method)
    return Policies(act, members, tuple(seeds), tuple(header["tasks"]))


def _read(folder: Path, kind: str) -> tuple[dict[str, Any], Settings, Spec]:
    """A folder's header, and what it says."""
    header, settings = saved(folder, kind)
    return header, settings, Spec(**header["spec"])


def _act(method: Method, spec: Spec, policy: Any, observation: jax.Array) -> jax.Array:
    chex.assert_axis_dimension(observation, -1, spec.observations)
    mean, _ = method.act(policy, observation)
    return jnp.tanh(mean)


def _load(found: Found, method: Method) -> Learned:
    """What those have learned that were trained side by side, `[num_slots]`."""
    keys = jax.vmap(jax.random.key)(jnp.arange(found.num_slots))
    like = jax.eval_shape(jax.vmap(method.init), keys)
    learned = run_state.read_policies(found.folder, found.stage, like)
    return Learned(*jax.tree.map(jnp.asarray, learned))
