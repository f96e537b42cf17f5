"""A run's plan: its settings checked, its sizes derived, its functions built."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from rewire_jax.core.settings import Settings, flag, require, validate
from rewire_jax.envs.base import Environment, HostEnvironment, Task
from rewire_jax.envs.scenarios import Scenario, make_scenario
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Spec, count
from rewire_jax.nn import networks
from rewire_jax.training import compiled_functions, population, train_loop
from rewire_jax.training.compiled_functions import Program
from rewire_jax.training.member_functions import MemberFunctions
from rewire_jax.training.population import Member, Members


class Budget(NamedTuple):
    """How long a task is, and what choosing between candidates takes.

    Attributes:
      steps: vector steps in a task.
      offline_steps: after these, steps that only update from the buffer.
      rows: slots for candidates that are rolled out side by side; 0 where nothing is
        to be chosen.
    """

    steps: int
    offline_steps: int
    rows: int


class Plan(NamedTuple):
    """A run, prepared: everything that does not change while it goes on.

    Attributes:
      settings: checked and complete.
      scenario: as it was made.
      tasks: of the sequence that is run, stacked on a leading axis, on the host.
      names: of these tasks.
      members: the members.
      budget: of a task.
      spec: sizes of the networks and of the sequence.
      stacked: the members on a leading axis; copies of the first fill it up.
      mesh: the devices.
      program: the compiled functions.
    """

    settings: Settings
    scenario: Scenario
    tasks: Task
    names: tuple[str, ...]
    members: tuple[Member, ...]
    budget: Budget
    spec: Spec
    stacked: Members
    mesh: Mesh
    program: Program

    @property
    def num_slots(self) -> int:
        """Length of the members' axis."""
        return len(self.stacked.keys)

    @property
    def interactions(self) -> int:
        """Of training, in a task."""
        return self.budget.steps * self.settings.envs


def make_spec(settings: Settings, environment: Environment | HostEnvironment) -> Spec:
    """The static sizes that a method is made from."""
    return Spec(
        observations=environment.observation_size,
        actions=environment.action_size,
        hidden=settings.sac.hidden,
        depth=settings.sac.depth,
        tasks=settings.tasks,
    )


def base_size(spec: Spec) -> int:
    """Numbers in one plain policy, by which model sizes are divided."""
    return count(
        jax.eval_shape(lambda: networks.init_mlp(jax.random.key(0), spec.sizes()))
    )


def prepare(
    settings: Settings,
    scenario: Scenario | None = None,
    members: Sequence[Member] = (),
    num_slots: int = 0,
) -> Plan:
    """Checks the settings and builds what they describe; compiles nothing.

    Args:
      settings: of the run.
      scenario: one of your own; otherwise made from the settings.
      members: the members, in place of one for each seed; their settings may differ
        from the run's in traced numbers, and are not checked here.
      num_slots: length of the members' axis; that of the members by default.

    Raises:
      UserError: a setting makes no sense.
    """
    settings, scenario = complete(settings, scenario)
    seeds = range(settings.seed, settings.seed + settings.seeds)
    members = members or population.cross([(settings.sac, settings.options)], seeds)
    filled = [*members, *[members[0]] * (num_slots - len(members))]
    mesh = population.mesh(len(filled))
    functions = make_functions(settings, scenario)
    sequence = scenario.tasks[: settings.tasks]
    return Plan(
        settings=settings,
        scenario=scenario,
        tasks=jax.tree.map(lambda *x: np.stack(x), *[t.data for t in sequence]),
        names=tuple(task.name for task in sequence),
        members=tuple(members),
        budget=make_budget(settings, functions),
        spec=functions.spec,
        stacked=population.place(population.stack(filled), mesh),
        mesh=mesh,
        # The numbers among the options do not matter here; runs that differ in them
        # alone share the program.
        program=compiled_functions.build(
            functions, jax.tree.map(lambda _: 0.0, settings.options), mesh
        ),
    )


def complete(
    settings: Settings, scenario: Scenario | None = None
) -> tuple[Settings, Scenario]:
    """The settings, checked and complete, and the scenario that they are for.

    Raises:
      UserError: a setting makes no sense.
    """
    validate(settings)
    options = find_method(settings.method).settings
    require(
        isinstance(settings.options, options),
        f"--method {settings.method} takes {options.__name__} as options, not "
        f"{type(settings.options).__name__}",
    )
    settings = dataclasses.replace(settings, options=settings.options.checked())
    scenario = scenario or make_scenario(
        settings.scenario, settings.backend, settings.reward
    )
    for name, made in (("scenario", scenario.name), ("backend", scenario.backend)):
        given = getattr(settings, name)
        require(given == made, f"{flag(name)} {given}: the run is on {made}; drop it")
    require(
        settings.tasks <= len(scenario.tasks),
        f"--tasks {settings.tasks}: {scenario.name} has {len(scenario.tasks)}",
    )
    return settings, scenario


def make_functions(settings: Settings, scenario: Scenario) -> MemberFunctions:
    """What a run does with one member; nothing is computed yet.

    Raises:
      UserError: the scenario cannot be run so.
    """
    environment = scenario.environment
    shape = train_loop.LoopConfig(
        envs=settings.envs,
        updates=settings.updates,
        warmup=settings.warmup // settings.envs,
        random_steps=settings.random_interactions // settings.envs,
        transitions=min(settings.interactions, settings.buffer) // settings.envs,
        update_every=settings.update_every,
        overlap=settings.overlap,
    )
    hosted = isinstance(environment, HostEnvironment)
    require(
        hosted or not settings.overlap,
        f"--overlap: {scenario.name} on {scenario.backend} steps on the device, where "
        "nothing is left to overlap",
    )
    least = min(settings.interactions // settings.envs, environment.episode_length)
    require(
        shape.transitions >= least or not hosted,
        f"--buffer {settings.buffer} is too short for an episode, which is taken up "
        f"again from it: give at least {least * settings.envs}",
    )
    make = find_method(settings.method).make
    return MemberFunctions(environment, make, make_spec(settings, environment), shape)


def make_budget(settings: Settings, functions: MemberFunctions) -> Budget:
    """How the interactions of a task are spent.

    Raises:
      UserError: they do not suffice.
    """
    environment = functions.environment
    method = functions.make(functions.spec, settings.options)
    candidates = _count_candidates(settings, functions)
    interactions = settings.interactions
    round_ = settings.update_every * settings.envs
    if method.in_budget:
        played = candidates * settings.selection_episodes
        interactions -= played * environment.episode_length
        require(
            interactions >= settings.warmup + round_,
            f"--interactions {settings.interactions} must also pay for "
            f"{played} episodes of choosing between policies: raise it, or "
            "lower --selection-episodes or --warmup",
        )
    # Rows for nothing let the compiled function of an evaluation serve here, too.
    same = settings.selection_episodes == settings.eval_episodes
    hosted = isinstance(environment, HostEnvironment)
    alike = candidates and same and not hosted
    return Budget(
        steps=interactions // round_ * settings.update_every,
        offline_steps=-(
            -int(method.offline * settings.interactions) // settings.updates
        ),
        rows=max(candidates, settings.tasks) if alike else candidates,
    )


def _count_candidates(settings: Settings, functions: MemberFunctions) -> int:
    """How many policies the method has rolled out at the end of a task."""
    method = functions.make(functions.spec, settings.options)
    if method.candidates is None or not settings.selection_episodes:
        return 0
    member = Members(jax.random.key(0), settings.sac, settings.options)
    learner = jax.eval_shape(functions.init, member)
    return len(jax.eval_shape(functions.candidates, member, learner, 0).valid)
