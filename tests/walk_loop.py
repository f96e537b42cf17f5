"""Runs of seconds in which the walker of `tests.walk` is trained."""

import dataclasses

from rewire_jax.core.settings import Settings
from rewire_jax.training.presets import preset
from rewire_jax.training.run_setup import Plan, prepare
from tests import loops, walk
from tests.tiny import PLAIN

EVERY = 4


def settings(method: str = "ft1", **changes) -> Settings:
    quick = preset(walk.scenario(walk.COMPILED), method, "quick")
    shape = {
        "interactions": 160,
        "envs": 1,
        "updates": 3,
        "update_every": EVERY,
        "warmup": 6,
        "random_interactions": 5,
        "eval_episodes": 3,
        "selection_episodes": 1,
        "report_every": 40,
        "checkpoint_every": 0,
    }
    sac = dataclasses.replace(quick.sac, hidden=12, depth=1, batch_size=8, **PLAIN)
    return dataclasses.replace(quick, sac=sac, **(shape | changes))


def planned(environment=None, method="ft1", **changes) -> Plan:
    environment = environment or walk.walker()
    return prepare(settings(method, **changes), walk.scenario(environment))


def begin(plan: Plan, index=0):
    return loops.begin(plan.program, plan.stacked, walk.TASKS, index)


def go(plan: Plan, state, chunks, time=0, index=0):
    return loops.go(plan.program, plan.stacked, walk.TASKS, state, chunks, time, index)
