"""Policies of a run, finished or not, as plain functions."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.arguments import check_optional, check_whole, require
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Method
from rewire_jax.methods.spec import Spec
from rewire_jax.run import halving, run_checkpoints, sweep_members
from rewire_jax.run.halving import Array
from rewire_jax.run.run_checkpoints import saved
from rewire_jax.run.sweep_members import Found
from rewire_jax.storage import fields, run_folder
from rewire_jax.storage.json_lines import reading
from rewire_jax.training import population
from rewire_jax.training.acting import Act, Learned, act_function, mean_action
from rewire_jax.training.run_setup import spec_of

PolicyFunction = Callable[[jax.Array], jax.Array]
"""`[..., observations]` -> actions `[..., actions]` in [-1, 1]."""


class Policies(NamedTuple):
    """The policies of all members of a run: arrays, and a pure function of them.

    Attributes:
      act: `(member, task, observation) -> action`. `member` is a `Learned`, `task` a
        `[]` int, `observation` `[..., observations]`. The action `[..., actions]` is in
        [-1, 1], without exploration. You can jit it, and vmap it over members, tasks
        or both. It raises `AssertionError` for observations of another length, and
        for what is not one member; `ValueError` for a task that is not there, unless
        it is traced, when JAX takes the nearest.
      members: values of all members, with a leading axis `[seeds]` on every leaf. JAX
        takes the last member for an index that is too large: see `member`.
      seeds: seeds of the members, in the same order.
      tasks: names of the sequence.
      candidates: `member -> tasks`, the tasks trained so far; of tasks whose policies
        are equal, the first.
    """

    act: Act
    members: Learned
    seeds: tuple[int, ...]
    tasks: tuple[str, ...]
    candidates: Callable[[Learned], tuple[int, ...]]

    def member(self, seed: int) -> Learned:
        """The member that was trained with a seed; `UserError` if there is none."""
        check_whole("seed", seed)
        require(seed in self.seeds, f"there is no seed {seed}: see `seeds`")
        place = self.seeds.index(seed)
        return jax.tree.map(lambda leaf: leaf[place], self.members)

    def choose(
        self, member: Learned, play: Callable[[int], Any], *, trials: int = 2
    ) -> int:
        """Chooses the policy for an unknown task, by its returns in trials of it.

        See `halving.choose`; `evaluate` chooses in the same way.

        Args:
          member: the member whose policies are candidates.
          play: `task -> return`; plays a trial of the unknown task by the policy of
            `task`, from a reset. All trials must have the same length.
          trials: how often each remaining candidate plays in a round.

        Returns:
          The task whose policy was chosen, for `act`.

        Raises:
          UserError: `trials` is no whole number from 1.
        """
        check_whole("trials", trials, 1)

        def returns(tasks: Array, playing: Array, round_: int) -> Array:
            del playing, round_  # one member: all candidates play
            played = [
                [float(play(task)) for _ in range(trials)] for task in tasks.tolist()
            ]
            return np.mean(played, axis=1)

        tasks = np.array(self.candidates(member))
        return int(halving.choose(returns, tasks, np.asarray(len(tasks))))


def load_policy(
    run: str | Path,
    *,
    task: int,
    seed: int | None = None,
    stage: int | None = None,
    member: int | None = None,
) -> PolicyFunction:
    """Loads a learned policy as a pure function, from the folder of a run.

    Args:
      run: folder of the run, or of a sweep.
      task: which task of the sequence to act in, from 0. A task not yet learned at
        that stage gets the latest policy.
      seed: seed of the member; the first seed of the run if None.
      stage: load the policy from after this task's training; the latest if None.
      member: only for a sweep, instead of the seed: a number in members.csv.

    Returns:
      A function from an observation `[..., observations]` of the scenario's environment
      to an action `[..., actions]`, without exploration. You can jit and vmap it. It
      raises `AssertionError` for observations of another length.

    Raises:
      UserError: no such run, task, seed, member or stage, or a damaged checkpoint.
    """
    check_whole("--task", task)
    for name, value in (("--seed", seed), ("--stage", stage), ("--member", member)):
        check_optional(name, value)
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
        found = sweep_members.find(folder, member, stage)
        members = sweep_members.members_of(folder, header, settings)
        owner = run_checkpoints.identity(settings, [members[n] for n in found.members])
        options = members[member].options
    else:
        if member is not None:
            raise UserError(f"{folder} holds a run: give seed, not member")
        seed = settings.seed if seed is None else seed
        owner = run_checkpoints.identity(settings, population.of_run(settings))
        options = settings.options
        place = seed - settings.seed
        found = Found(folder, stage, place, settings.seeds, ())
        if not 0 <= found.place < found.num_slots:
            raise UserError(
                f"{folder} has no seed {seed}: see {run_folder.HEADER} there"
            )
    method = find_method(settings.method).build(spec, options)
    learned = jax.tree.map(lambda leaf: leaf[found.place], _load(found, method, owner))
    policy = method.policy(learned.params, learned.method_state, jnp.asarray(task))
    return functools.partial(mean_action, method, spec, policy)


def load_policies(run: str | Path, *, stage: int | None = None) -> Policies:
    """Loads all policies of a run at once, for example to vmap over or compare them.

    Args:
      run: folder of the run.
      stage: load the policies from after this task's training; the latest if None.

    Raises:
      UserError: no such run or stage, a sweep, or a damaged checkpoint.
    """
    check_optional("stage", stage)
    folder = Path(run)
    require(
        run_folder.kind(folder) == "run",
        f"{folder} holds a sweep, whose members differ in settings: load_policy gives "
        "the policies of one",
    )
    header, settings, spec = _read(folder, "run")
    method = find_method(settings.method).build(spec, settings.options)
    stage = run_checkpoints.latest(folder) if stage is None else stage

    def candidates(member: Learned) -> tuple[int, ...]:
        trained = [method.policy(*member, jnp.asarray(t)) for t in range(stage + 1)]
        return tuple(sorted(set(halving.first_equal(trained))))

    members = population.of_run(settings)
    owner = run_checkpoints.identity(settings, members)
    learned = _load(Found(folder, stage, 0, settings.seeds, ()), method, owner)
    seeds = tuple(member.seed for member in members)
    act = act_function(method, spec)
    return Policies(act, learned, seeds, tuple(header["tasks"]), candidates)


def _read(folder: Path, kind: str) -> tuple[dict[str, Any], Settings, Spec]:
    """A folder's header, its settings and its sizes."""
    header, settings = saved(folder, kind)
    with reading(folder / run_folder.HEADER):
        sizes = fields.checked(header["spec"], fields.SPEC)
    spec = spec_of(settings, sizes["observations"], sizes["actions"])
    return header, settings, spec


def _load(found: Found, method: Method, owner: Mapping[str, Any]) -> Learned:
    """What the members that trained together have learned, `[num_slots]`."""
    keys = jax.vmap(jax.random.key)(jnp.arange(found.num_slots))
    like = jax.eval_shape(jax.vmap(method.init), keys)
    learned, _ = run_checkpoints.read_policies(found.folder, found.stage, like, owner)
    return Learned(*jax.tree.map(jnp.asarray, learned))
