"""A run's plan: settings checked, sizes derived, functions built."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax import config, networks, population, training
from rewire_jax.config import Settings, require
from rewire_jax.envs.base import Task
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Spec, count
from rewire_jax.population import Members
from rewire_jax.scenarios import Scenario, make_scenario
from rewire_jax.training import Program


class Plan(NamedTuple):
    """A run, prepared: everything that does not change while it goes on.

    Attributes:
      settings: checked and complete.
      scenario: as it was made.
      tasks: of the sequence that is run, stacked on a leading axis.
      names: of these tasks.
      seeds: of the members.
      steps: steps of all environments in a task.
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
    spec: Spec
    members: Members
    program: Program


def base_size(spec: Spec) -> int:
    """Numbers in one plain policy, by which model sizes are divided."""
    sizes = [spec.observations, *[spec.hidden] * spec.depth, 2 * spec.actions]
    return count(jax.eval_shape(lambda: networks.init_mlp(jax.random.key(0), sizes)))


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
    spec = Spec(
        observations=environment.observation_size,
        actions=environment.action_size,
        hidden=settings.sac.hidden,
        depth=settings.sac.depth,
        tasks=settings.tasks,
    )
    shape = training.Shape(
        envs=settings.envs,
        updates=settings.updates,
        warmup=settings.warmup // settings.envs,
        random=settings.random_interactions // settings.envs,
        transitions=min(settings.interactions, settings.buffer) // settings.envs,
    )
    seeds = tuple(range(settings.seed, settings.seed + settings.seeds))
    sequence = scenario.tasks[: settings.tasks]
    return Plan(
        settings=settings,
        scenario=scenario,
        tasks=jax.tree.map(lambda *x: jnp.stack(x), *[t.data for t in sequence]),
        names=tuple(task.name for task in sequence),
        seeds=seeds,
        steps=settings.interactions // settings.envs,
        spec=spec,
        members=population.members([(settings.sac, settings.options)], seeds),
        program=training.build(environment, entry.make, spec, shape, settings.options),
    )
