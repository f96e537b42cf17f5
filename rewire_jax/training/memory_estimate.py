"""Estimates the device memory of a member, before anything is compiled.

Stored arrays are counted from their shapes. Temporary arrays are counted from the
traced operations: the estimate is the largest total at any time, if each result is kept
from its operation to its last use. XLA needs less if it fuses operations, and more if
it copies.
"""

import functools
import math
import resource
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Jaxpr, JaxprEqn, Var, jaxprs_in_params

from rewire_jax.core.arguments import require
from rewire_jax.core.errors import UserError
from rewire_jax.core.machine_memory import machine_bytes
from rewire_jax.envs.base import HostEnvironment
from rewire_jax.methods import find_method
from rewire_jax.methods.shared import map_own
from rewire_jax.training import colored_noise, rollout, train_loop
from rewire_jax.training.run_setup import Plan
from rewire_jax.training.time_estimate import least_hours

# Share of a device's memory; the rest is for compiled code and other programs.
_SHARE = 0.8
# With more members, a CPU's caches are too small and each member takes longer.
_SIDE_BY_SIDE = 8
_LISTED = 10_000  # bytes on the host for a member's settings, name and place
_YEAR = 365.25 * 24  # hours
_YEARS = 10


class Need(NamedTuple):
    """The memory of one member, in bytes.

    Attributes:
      learner: everything that learning changes.
      buffer: the replay buffer, during training.
      environments: the environments, during training.
      work: temporary arrays of an update, a step or a selection, during training.
      evaluation: temporary arrays of an evaluation, or of a selection at a task's end;
        there is no buffer then.
    """

    learner: int
    buffer: int
    environments: int
    work: int
    evaluation: int

    @property
    def total(self) -> int:
        """The largest total at any time."""
        training = self.buffer + self.environments + self.work
        return self.learner + max(training, self.evaluation)

    def __str__(self) -> str:
        pairs = zip(self._fields, self, strict=True)
        parts = ", ".join(f"{name} {size / 1e6:.3g}" for name, size in pairs)
        return f"a member needs {self.total / 1e6:.3g} MB: {parts}"


def _held(plan: Plan) -> tuple[Any, Any]:
    """Shapes of a learner between tasks, and of everything stored during a task."""
    task = jax.tree.map(lambda leaf: leaf[0], plan.tasks)
    fresh = jax.eval_shape(plan.program.init, plan.stacked)
    active = jax.ShapeDtypeStruct((plan.num_slots,), bool)
    return fresh, plan.program.state_shape(plan.stacked, fresh, active, 0, task)


def check(plan: Plan) -> None:
    """Raises `UserError` if the arrays stored in training exceed the memory."""
    state = _held(plan)[1]
    held = size(state)
    if plan.settings.boundaries == "detected":
        held += size(state.collection.buffer)  # of two segments, where one ends
    room = _total(list(plan.mesh.devices.flat))
    require(
        room is None or held <= room,
        f"a run of this size needs {held / 1e9:.3g} GB and at least "
        f"{least_hours(plan, len(plan.members)):.2g} hours, but the memory has "
        f"{(room or 0) / 1e9:.3g} GB: lower --seeds, --buffer, --envs or --hidden",
    )


def check_sweep(plan: Plan, members: int, folder: Path) -> None:
    """Raises `UserError` if nothing like this machine can train so many members.

    Args:
      plan: plan of any of them.
      members: their number.
      folder: folder of the sweep; it need not exist.
    """
    learner = jax.eval_shape(plan.program.init, plan.stacked)
    kept = size((learner.params, learner.method_state, learner.critic))
    kept *= plan.settings.tasks * members // plan.num_slots
    listed, years = members * _LISTED, least_hours(plan, members) / _YEAR
    there = next(x for x in (folder, *folder.absolute().parents) if x.exists())
    disk, memory = shutil.disk_usage(there).total, machine_bytes()
    require(
        kept <= disk and listed <= memory and years <= _YEARS,
        f"a sweep of {members:,} members keeps {kept / 1e9:.3g} GB in {folder}, lists "
        f"them in {listed / 1e9:.3g} GB of memory and takes at least {years:.2g} "
        f"years; there are {disk / 1e9:.3g} GB, {memory / 1e9:.3g} GB and {_YEARS}: "
        "give fewer values, --seeds or --random",
    )


def episodes_at_once(plan: Plan, policies: Any, rows: int, episodes: int) -> int:
    """How many of a member's episodes, in each row, the memory holds at once.

    Args:
      plan: plan of the run.
      policies: `[members, rows]`, or shapes.
      rows: number of policies of a member.
      episodes: how many are wanted; as many, or a part of them.

    Raises:
      UserError: not even one.
    """
    room = _total(list(plan.mesh.devices.flat))
    if room is None:
        return episodes
    count = episodes
    while plan.num_slots * _play(plan, policies, rows, count) > _SHARE * room:
        require(count > 1, "the memory is too small for an episode of each member")
        count = -(-count // 2)
    return count


def _cut(tree: Any, *shape: int, axes: int = 1) -> Any:
    """Shapes whose first `axes` axes are replaced."""
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((*shape, *x.shape[axes:]), x.dtype), tree
    )


def _play(plan: Plan, policies: Any, rows: int, episodes: int) -> int:
    """Bytes for a member's policies in `rows` rows, with `episodes` of each."""
    environment = plan.scenario.environment
    policies = map_own(lambda x: _cut(x, 1, rows, axes=2), _cut(policies, 1))
    if isinstance(environment, HostEnvironment):
        return size(policies)  # episodes take nothing of the device
    entry = find_method(plan.settings.method)
    act = entry.build(plan.spec, plan.settings.options).act

    def roll(tasks, policies, keys):
        return rollout.episodes(environment, act, tasks, policies, keys, episodes)

    keys = _cut(plan.stacked.keys, 1, rows)
    return size(policies) + peak(roll, _cut(plan.tasks, rows), policies, keys)


def need(plan: Plan) -> Need:
    """The memory of each member of a plan; traces, but compiles nothing."""
    program, settings, spec = plan.program, plan.settings, plan.spec
    environment, entry = plan.scenario.environment, find_method(settings.method)
    fresh, state = _held(plan)

    def learn(member, state):
        return train_loop.update_from_buffer(
            member.keys,
            state,
            jnp.asarray(1),
            jnp.asarray(0),
            True,
            updates=settings.updates,
            environment=environment,
            method=entry.build(spec, member.options),
            settings=member.sac,
        )

    member, mine = _cut(plan.stacked), _cut(state)
    policies = jax.eval_shape(program.policies, plan.stacked, fresh)
    learner = size(mine.learner)
    work = [
        learner,  # a task's start and end each make one from the other
        peak(learn, member, mine),
        _play(plan, policies, 1, settings.envs),
    ]
    if program.consolidate:
        work.append(
            peak(program.consolidate, plan.stacked, state, 0, 1) // plan.num_slots
        )
    selection = 0
    if program.candidates and plan.budget.rows:
        chosen = jax.eval_shape(program.candidates, plan.stacked, fresh, 0)
        selection = _play(
            plan, chosen.policies, plan.budget.rows, settings.selection_episodes
        )
    if program.baseline:
        work.append(selection)
    environments = size(mine.collection) - size(mine.collection.buffer)
    environments += size(mine.acting)
    if settings.sac.noise_color:
        draw = functools.partial(
            colored_noise.colored,
            color=settings.sac.noise_color,
            length=environment.episode_length,
            shape=(settings.envs, environment.action_size),
        )
        environments += size(jax.eval_shape(draw, member.keys))
        work.append(peak(draw, member.keys))
    return Need(
        learner=learner,
        buffer=size(mine.collection.buffer),
        environments=environments,
        work=max(work),
        evaluation=max(
            _play(plan, policies, settings.tasks, settings.eval_episodes), selection
        ),
    )


def size(tree: Any) -> int:
    """Bytes of a pytree's arrays; they may be abstract."""
    return sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(tree))


def peak(function: Callable[..., Any], *arguments: Any) -> int:
    """The largest total of a function's results at any time, without its arguments."""
    return _peak(jax.make_jaxpr(function)(*arguments).jaxpr)


def _peak(jaxpr: Jaxpr) -> int:
    last = {
        v: i for i, e in enumerate(jaxpr.eqns) for v in (*e.outvars, *_variables(e))
    }
    last |= dict.fromkeys((v for v in jaxpr.outvars if isinstance(v, Var)), -1)
    held: dict[Var, int] = {}
    active = most = 0
    for index, equation in enumerate(jaxpr.eqns):
        made = {v: size(v.aval) for v in equation.outvars}
        given = sum(made.values())
        inside = max(map(_peak, jaxprs_in_params(equation.params)), default=0)
        if equation.primitive.name in ("scan", "while"):
            # The old carry is kept until the new one is complete.
            inside += given
        most = max(most, active + max(inside, given))
        held |= made
        held = {v: bytes for v, bytes in held.items() if last[v] != index}
        active = sum(held.values())
    return most


def _variables(equation: JaxprEqn) -> list[Var]:
    return [v for v in equation.invars if isinstance(v, Var)]


def device_bytes(devices: Sequence[jax.Device]) -> int:
    """Bytes that members may use on these devices together.

    Raises:
      UserError: a device does not report its memory.
    """
    total = _total(devices)
    if total is None:
        raise UserError(
            f"{devices[0].device_kind} does not report its memory: set "
            "--members-per-batch"
        )
    return int(_SHARE * total)


def _total(devices: Sequence[jax.Device]) -> int | None:
    """Bytes of these devices together; None if one does not report its memory."""
    if devices[0].platform == "cpu":
        # All CPU devices are one machine.
        return machine_bytes()
    limits = [(device.memory_stats() or {}).get("bytes_limit") for device in devices]
    known = [limit for limit in limits if limit]
    return sum(known) if len(known) == len(limits) else None


def most_held() -> dict[str, int]:
    """The peak memory so far, in bytes.

    Returns:
      `process`: of this process on its machine; `device`: of all its devices together,
      if they have their own memory and report it.
    """
    # In kilobytes, except on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    held = {"process": unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}
    stats = [device.memory_stats() or {} for device in jax.local_devices()]
    peaks = [each["peak_bytes_in_use"] for each in stats if "peak_bytes_in_use" in each]
    return held | ({"device": sum(peaks)} if peaks else {})


def fitting(each: Need, devices: Sequence[jax.Device]) -> int:
    """The number of members to train at once on these devices.

    Raises:
      UserError: one member does not fit.
    """
    room = device_bytes(devices)
    # All CPU devices share the same memory.
    shares = 1 if devices[0].platform == "cpu" else len(devices)
    number = shares * (room // shares // each.total)
    require(
        number > 0,
        f"{each}; the memory has {room / shares / 1e6:.3g} MB: lower --buffer, --envs "
        "or --eval-episodes, or set --members-per-batch to try anyway",
    )
    if devices[0].platform == "cpu":
        number = min(number, _SIDE_BY_SIDE * len(devices))
    return number
