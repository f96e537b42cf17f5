"""The compiled loop on a small reach: its programs, and a crowd of members."""

import dataclasses

from rewire_jax.core.settings import SacSettings
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.methods import find_method
from rewire_jax.methods.spec import Spec
from rewire_jax.training import compiled_functions as compiled
from rewire_jax.training import loop_state, population
from rewire_jax.training.member_functions import MemberFunctions
from tests import loops

SCENARIO = make_scenario("probe/reach")
TASKS = [task.data for task in SCENARIO.tasks]
# A width that no other loop has, so that traces are counted for this one alone.
SPEC = Spec(observations=2, actions=2, hidden=18, depth=1, tasks=len(TASKS))
WARMUP, RANDOM = 5, 12
SHAPE = loop_state.LoopConfig(
    envs=4, updates=3, warmup=WARMUP, random_steps=RANDOM, transitions=16
)
PLAIN = SacSettings(
    lr_policy=3e-3,
    lr_critic=3e-3,
    hidden=SPEC.hidden,
    depth=SPEC.depth,
    batch_size=8,
    time_limit="bootstrap",
)
OTHER = dataclasses.replace(
    PLAIN,
    lr_policy=1e-3,
    lr_critic=5e-3,
    lr_temperature=1e-2,
    reward_scale=4.0,
    target_multiplier=0.3,
    initial_temperature=0.5,
    discount=0.8,
    target_rate=0.1,
)
SEEDS = (3, 8)
MESH = population.mesh(1)


def options(method, number):
    """The settings of a method's configuration number 0 or 1."""
    settings = find_method(method).preset("probe/reach", len(TASKS), "paper")
    if method == "rewire":
        changes = {"modes": 2 + number, "alpha": 0.1**number, "tau": 1 / (1 + number)}
        settings = dataclasses.replace(settings, mode_slots=3, **changes)
    return settings.checked()


def configurations(method):
    return [(sac, options(method, n)) for n, sac in enumerate((PLAIN, OTHER))]


def build(method, environment=SCENARIO.environment, shape=SHAPE):
    of = MemberFunctions(environment, find_method(method).make, SPEC, shape)
    return compiled.build(of, options(method, 0), MESH)


def crowd(method="ft1"):
    return population.stack(population.cross(configurations(method), SEEDS))


def begin(program, members, index=0):
    return loops.begin(program, members, TASKS, index)


def go(program, members, state, chunks, time=0, index=0):
    return loops.go(program, members, TASKS, state, chunks, time, index)
