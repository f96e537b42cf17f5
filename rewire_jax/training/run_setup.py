"""The plan of a run: checked settings, derived sizes, compiled functions."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from rewire_jax.core.arguments import flag, require
from rewire_jax.core.pytrees import count
from rewire_jax.core.settings import (
    SacSettings,
    Settings,
    typed_settings,
    validate,
)
from rewire_jax.envs.base import Environment, HostEnvironment, Task
from rewire_jax.envs.scenarios import Scenario, check_scenario, make_scenario
from rewire_jax.methods import find_method, segments
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.training import change_detection, compiled_functions, population
from rewire_jax.training.compiled_functions import Program
from rewire_jax.training.loop_state import LoopConfig
from rewire_jax.training.member_functions import MemberFunctions
from rewire_jax.training.population import Member, Members


class Budget(NamedTuple):
    """The length of a task, and the number of candidates to evaluate.

    Attributes:
      steps: vector steps in a task.
      offline_steps: rounds of offline updates after these steps.
      rows: number of policies that are evaluated together when the method chooses; 0
        if it chooses nothing.
    """

    steps: int
    offline_steps: int
    rows: int


class Plan(NamedTuple):
    """Everything that does not change during a run.

    Attributes:
      settings: checked and complete.
      scenario: the scenario.
      tasks: tasks of the run, stacked on a leading axis, on the host.
      names: names of these tasks.
      members: the members.
      budget: budget of a task.
      spec: sizes of the networks and of the sequence.
      stacked: the members on a leading axis, padded with copies of the first.
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
        """Training interactions in a task."""
        return self.budget.steps * self.settings.envs


def make_spec(settings: Settings, environment: Environment | HostEnvironment) -> Spec:
    """Returns what a method is made from, besides its settings."""
    return spec_of(settings, environment.observation_size, environment.action_size)


def spec_of(settings: Settings, observations: int, actions: int) -> Spec:
    """The same, from the sizes of the environment."""
    return Spec(
        observations=observations,
        actions=actions,
        hidden=settings.sac.hidden,
        depth=settings.sac.depth,
        tasks=settings.tasks,
        network=settings.sac.network,
        updates=settings.updates
        * (settings.interactions - settings.warmup)
        // (settings.envs * settings.update_every),
        segments=2 * settings.tasks if settings.boundaries == "detected" else 0,
    )


def base_size(spec: Spec) -> int:
    """Returns the parameters of one plain policy, the unit of model sizes."""
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
      settings: settings of the run.
      scenario: your own scenario; if None, the settings name it.
      members: the members; by default one for each seed. Their settings may differ from
        the settings of the run in traced values, and are not checked here.
      num_slots: length of the members' axis; by default the number of members.

    Raises:
      UserError: a setting is invalid.
    """
    settings, scenario = complete(settings, scenario)
    members = members or population.of_run(settings)
    filled = [*members, *[members[0]] * (num_slots - len(members))]
    require(
        settings.boundaries == "given" or len(filled) == 1,
        "--boundaries detected: members would notice changes at different times; train "
        "each seed alone, with --seeds 1",
    )
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
        # Traced options do not matter here: runs that differ only in them share the
        # program.
        program=compiled_functions.build(
            functions, jax.tree.map(lambda _: 0.0, settings.options), mesh
        ),
    )


def complete(
    settings: Settings, scenario: Scenario | None = None
) -> tuple[Settings, Scenario]:
    """Returns checked, complete settings and their scenario.

    Raises:
      UserError: a setting is invalid, or a task has NaN.
    """
    require(
        isinstance(settings, Settings),
        f"settings must be Settings, such as preset gives, not {settings!r:.80}",
    )
    require(
        isinstance(settings.sac, SacSettings),
        f"sac must be SacSettings, not {settings.sac!r:.80}",
    )
    options = find_method(settings.method).settings
    require(
        isinstance(settings.options, options),
        f"--method {settings.method} takes {options.__name__} as options, not "
        f"{type(settings.options).__name__}",
    )
    validate(settings)
    settings = typed_settings(settings)
    settings = dataclasses.replace(settings, options=settings.options.checked())
    if scenario is None:
        scenario = make_scenario(settings.scenario, settings.backend, settings.reward)
    check_scenario(scenario)
    for name, made in (("scenario", scenario.name), ("backend", scenario.backend)):
        given = getattr(settings, name)
        require(given == made, f"{flag(name)} {given}: the run is on {made}; drop it")
    require(
        settings.tasks <= len(scenario.tasks),
        f"--tasks {settings.tasks}: {scenario.name} has {len(scenario.tasks)}",
    )
    for task in scenario.tasks[: settings.tasks]:
        for path, leaf in jax.tree.leaves_with_path(task.data):
            require(
                not np.isnan(leaf).any(),
                f"task {task.name!r} has NaN in its {jax.tree_util.keystr(path)}",
            )
    return settings, scenario


def make_functions(settings: Settings, scenario: Scenario) -> MemberFunctions:
    """Returns the functions of one member; computes nothing.

    Raises:
      UserError: the scenario does not fit the settings.
    """
    environment = scenario.environment
    config = LoopConfig(
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
        config.transitions >= least or not hosted,
        f"--buffer {settings.buffer} is too short for an episode, which --resume "
        f"replays from it: give at least {least * settings.envs}",
    )
    if settings.boundaries == "detected":
        _check_detection(settings, config, environment)
    make = find_method(settings.method).make
    return MemberFunctions(environment, make, make_spec(settings, environment), config)


def _check_detection(
    settings: Settings,
    config: LoopConfig,
    environment: Environment | HostEnvironment,
) -> None:
    """Raises `UserError` if changes of task cannot be noticed."""
    # Varied environments have a simulator for each task, and reset at fixed times.
    require(
        isinstance(environment, Environment) and not environment.varied,
        f"--boundaries detected: on {settings.backend} an episode cannot go on in "
        f"another task of {settings.scenario}; use a scenario on Brax",
    )
    least = (change_detection.WINDOW + 1) * chunk_steps(settings)
    require(
        config.transitions >= least,
        f"--boundaries detected compares {least * settings.envs} interactions, "
        f"{change_detection.WINDOW + 1} progress reports: lower --report-every, or "
        "raise --buffer and --interactions",
    )


def chunk_steps(settings: Settings) -> int:
    """Vector steps between two progress reports: whole rounds of updates."""
    rounds = settings.report_every // (settings.envs * settings.update_every)
    return max(rounds, 1) * settings.update_every


def make_budget(settings: Settings, functions: MemberFunctions) -> Budget:
    """Divides the interactions of a task between training and selection.

    Raises:
      UserError: there are too few.
    """
    environment = functions.environment
    method = segments.build(functions.make, functions.spec, settings.options)
    candidates = _count_candidates(settings, functions)
    require(
        not candidates or settings.boundaries == "given",
        "--boundaries detected: when a change is noticed, no policy can be tried on "
        "the task before it; add --selection-episodes 0",
    )
    interactions = settings.interactions
    round_ = settings.update_every * settings.envs
    if method.in_budget:
        played = candidates * settings.selection_episodes
        interactions -= played * environment.episode_length
        require(
            interactions >= settings.warmup + round_,
            f"--interactions {settings.interactions} must include {played} selection "
            "episodes: raise it, or lower --selection-episodes or --warmup",
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
    """Returns how many candidates the method has at the end of a task."""
    method = segments.build(functions.make, functions.spec, settings.options)
    if method.candidates is None or not settings.selection_episodes:
        return 0
    member = Members(jax.random.key(0), settings.sac, settings.options)
    learner = jax.eval_shape(functions.init, member)
    return len(jax.eval_shape(functions.candidates, member, learner, 0).valid)
