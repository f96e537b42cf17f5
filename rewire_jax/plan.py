"""A run's plan: settings checked, sizes derived, functions built."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax import config, networks, population, program, training
from rewire_jax.config import Settings, require
from rewire_jax.envs.base import Environment, Task
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Spec, count
from rewire_jax.population import Members
from rewire_jax.program import Program
from rewire_jax.scenarios import Scenario, make_scenario


class Plan(NamedTuple):
    """A run, prepared: everything that does not change while it goes on.

    Attributes:
      settings: checked and complete.
      scenario: as it was made.
      tasks: of the sequence that is run, stacked on a leading axis.
      names: of these tasks.
      seeds: of the members.
      steps: steps of all environments in a task.
      polishing: after these, steps that only update from the buffer.
      rows: candidates rolled out side by side, each perhaps several times; 0 where
        nothing is to be chosen.
      episodes: in each row.
      spec: sizes of the networks and of the sequence.
      members: what tells the members apart.
      program: the compiled functions.
    """

    settings: Settings
    scenario: Scenario
    tasks: Task
    names: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int
    polishing: int
    rows: int
    episodes: int
    spec: Spec
    members: Members
    program: Program

    @property
    def interactions(self) -> int:
        """Of training, in a task."""
        return self.steps * self.settings.envs


def make_spec(settings: Settings, environment: Environment) -> Spec:
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


def prepare(settings: Settings, scenario: Scenario | None = None) -> Plan:
    """Checks the settings and builds what they describe; compiles nothing.

    Raises:
      UserError: a setting makes no sense.
    """
    config.validate(settings)
    entry = find_method(settings.method)
    settings = dataclasses.replace(settings, options=settings.options.checked())
    scenario = scenario or make_scenario(settings.scenario, settings.backend)
    require(
        settings.tasks <= len(scenario.tasks),
        f"--tasks {settings.tasks}: {scenario.name} has {len(scenario.tasks)}",
    )
    environment = scenario.environment
    spec = make_spec(settings, environment)
    shape = training.Shape(
        envs=settings.envs,
        updates=settings.updates,
        warmup=settings.warmup // settings.envs,
        random=settings.random_interactions // settings.envs,
        transitions=min(settings.interactions, settings.buffer) // settings.envs,
    )
    seeds = tuple(range(settings.seed, settings.seed + settings.seeds))
    sequence = scenario.tasks[: settings.tasks]
    members = population.members([(settings.sac, settings.options)], seeds)
    # Its numbers do not matter; runs that differ in them alone share the program.
    example = jax.tree.map(lambda _: 0.0, settings.options)
    built = program.build(environment, entry.make, spec, shape, example)
    method = entry.make(spec, settings.options)
    rows, episodes = _selection(settings, built, members)
    budget = settings.interactions
    if method.in_budget:
        budget -= rows * episodes * environment.episode_length
        require(
            budget >= settings.warmup + settings.envs,
            f"--interactions {settings.interactions} must also pay for "
            f"{rows * episodes} episodes of choosing between policies: raise it, or "
            "lower --selection-episodes or --warmup",
        )
    return Plan(
        settings=settings,
        scenario=scenario,
        tasks=jax.tree.map(lambda *x: jnp.stack(x), *[t.data for t in sequence]),
        names=tuple(task.name for task in sequence),
        seeds=seeds,
        steps=budget // settings.envs,
        polishing=-(-int(method.offline * settings.interactions) // settings.updates),
        rows=rows,
        episodes=episodes,
        spec=spec,
        members=members,
        program=built,
    )


def _selection(settings: Settings, built: Program, members: Members) -> tuple[int, int]:
    """Rows of a selection, and the episodes in each."""
    if built.candidates is None or not settings.selection_episodes:
        return 0, 0
    learner = jax.eval_shape(built.init, members)
    number = jax.eval_shape(built.candidates, members, learner, 0).valid.shape[1]
    # In as many rows as an evaluation has tasks, both can be one compiled function.
    rows = max(number, settings.tasks)
    if rows > settings.selection_episodes:
        rows = number
    return rows, max(settings.selection_episodes // rows, 1)
