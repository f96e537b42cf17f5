"""A run's plan: settings checked, sizes derived, functions built."""

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
from rewire_jax.training.population import Member, Members


class Plan(NamedTuple):
    """A run, prepared: everything that does not change while it goes on.

    Attributes:
      settings: checked and complete.
      scenario: as it was made.
      tasks: of the sequence that is run, stacked on a leading axis, on the host.
      names: of these tasks.
      members: the members.
      steps: steps of all environments in a task.
      offline_steps: after these, steps that only update from the buffer.
      rows: slots for candidates that are rolled out side by side; 0 where nothing is
        to be chosen.
      spec: sizes of the networks and of the sequence.
      stacked: the same, on a leading axis; fillers behind them make up the numbers.
      mesh: the devices.
      program: the compiled functions.
    """

    settings: Settings
    scenario: Scenario
    tasks: Task
    names: tuple[str, ...]
    members: tuple[Member, ...]
    steps: int
    offline_steps: int
    rows: int
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
        return self.steps * self.settings.envs


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
      num_slots: for members; those beyond the members are filled.

    Raises:
      UserError: a setting makes no sense.
    """
    validate(settings)
    entry = find_method(settings.method)
    require(
        isinstance(settings.options, entry.settings),
        f"--method {settings.method} takes {entry.settings.__name__} as options, not "
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
    environment = scenario.environment
    spec = make_spec(settings, environment)
    shape = train_loop.LoopConfig(
        envs=settings.envs,
        updates=settings.updates,
        warmup=settings.warmup // settings.envs,
        random=settings.random_interactions // settings.envs,
        transitions=min(settings.interactions, settings.buffer) // settings.envs,
        every=settings.update_every,
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
    sequence = scenario.tasks[: settings.tasks]
    seeds = range(settings.seed, settings.seed + settings.seeds)
    members = members or population.cross([(settings.sac, settings.options)], seeds)
    filled = [*members, *[members[0]] * (num_slots - len(members))]
    mesh = population.mesh(len(filled))
    stacked = population.place(population.stack(filled), mesh)
    # Its numbers do not matter; runs that differ in them alone share the program.
    example = jax.tree.map(lambda _: 0.0, settings.options)
    built = compiled_functions.build(
        environment, entry.make, spec, shape, example, mesh
    )
    method = entry.make(spec, settings.options)
    number, rows = _selection(settings, built, stacked, hosted)
    budget, round_ = settings.interactions, settings.update_every * settings.envs
    if method.in_budget:
        played = number * settings.selection_episodes
        budget -= played * environment.episode_length
        require(
            budget >= settings.warmup + round_,
            f"--interactions {settings.interactions} must also pay for "
            f"{played} episodes of choosing between policies: raise it, or "
            "lower --selection-episodes or --warmup",
        )
    return Plan(
        settings=settings,
        scenario=scenario,
        tasks=jax.tree.map(lambda *x: np.stack(x), *[t.data for t in sequence]),
        names=tuple(task.name for task in sequence),
        members=tuple(members),
        steps=budget // round_ * settings.update_every,
        offline_steps=-(
            -int(method.offline * settings.interactions) // settings.updates
        ),
        rows=rows,
        spec=spec,
        stacked=stacked,
        mesh=mesh,
        program=built,
    )


def _selection(
    settings: Settings, built: Program, stacked: Members, hosted: bool
) -> tuple[int, int]:
    """How many candidates there are, and the rows to play them in."""
    if built.candidates is None or not settings.selection_episodes:
        return 0, 0
    learner = jax.eval_shape(built.init, stacked)
    number = jax.eval_shape(built.candidates, stacked, learner, 0).valid.shape[1]
    # Some rows for nothing, where that lets an evaluation's compiled function serve.
    same = settings.selection_episodes == settings.eval_episodes
    return number, max(number, settings.tasks) if same and not hosted else number
