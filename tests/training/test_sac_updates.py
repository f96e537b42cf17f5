"""Updates in groups, without branches, are the updates with branches."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from rewire_jax.core.settings import SacSettings
from rewire_jax.methods import find_method
from rewire_jax.training import compiled_functions, sac_updates
from rewire_jax.training.member_functions import MemberFunctions
from tests import reach_loop
from tests.loops import equal

BOTH = {1: "branches", 4: "groups"}
# Four updates follow each step after the warm-up.
SHAPE = reach_loop.SHAPE._replace(updates=4)
STEPS = reach_loop.WARMUP + 6


@pytest.fixture
def forced(monkeypatch):
    """`(group, method) -> program`, whatever the device."""

    def build(group, method):
        monkeypatch.setattr(sac_updates, "group_size", lambda *_: group)
        # Not equal to that of another program, which would be taken instead.
        make = functools.partial(find_method(method).make)
        scenario = reach_loop.SCENARIO.environment
        of = MemberFunctions(scenario, make, reach_loop.SPEC, SHAPE)
        options = reach_loop.options(method, 0)
        return compiled_functions.build(of, options, reach_loop.MESH)

    return build


def members(method):
    crowd = reach_loop.crowd(method)
    return crowd._replace(
        sac=dataclasses.replace(crowd.sac, policy_delay=4, target_delay=2)
    )


@pytest.mark.parametrize("method", ["ft1", "rewire"])
def test_groups_and_branches_come_to_the_same(forced, method):
    made, conditionals = {}, {}
    for group in BOTH:
        program, crowd = forced(group, method), members(method)
        state = reach_loop.begin(program, crowd)
        task = reach_loop.TASKS[0]
        lowered = program.chunk.lower(crowd, state, 0, task, 0, STEPS)
        conditionals[group] = lowered.as_text().count("stablehlo.case")
        made[group] = reach_loop.go(program, crowd, state, [STEPS])
    equal(made[1][0].learner, made[4][0].learner)
    equal(made[1][1][0], made[4][1][0])
    # Otherwise nothing would have been compared: the last one has changed all.
    assert np.all(made[1][1][0].updates == STEPS - reach_loop.WARMUP)
    assert conditionals[1] - conditionals[4] == 2


@pytest.mark.parametrize(
    ("delays", "updates", "group"),
    [
        ((2, 2), 64, 2),
        ((4, 2), 64, 4),
        ((1, 1), 7, 1),
        ((2, 1), 7, 1),  # not whole groups
        ((2, 3), 12, 1),  # long to compile
    ],
)
def test_groups_are_whole_and_short(monkeypatch, delays, updates, group):
    settings = SacSettings(policy_delay=delays[0], target_delay=delays[1])
    assert sac_updates.group_size(updates, settings) == 1
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert sac_updates.group_size(updates, settings) == group
