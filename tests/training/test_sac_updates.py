"""Updates in groups, without branches, are the updates with branches."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.settings import SacSettings
from rewire_jax.core.transition import Batch
from rewire_jax.methods import find_method
from rewire_jax.training import compiled_functions, sac, sac_updates
from rewire_jax.training.member_functions import MemberFunctions
from tests.loops import equal
from tests.reach_loop import (
    MESH,
    PLAIN,
    SCENARIO,
    SHAPE,
    SPEC,
    TASKS,
    WARMUP,
    begin,
    crowd,
    go,
    options,
)

DELAYS = {"policy_delay": 4, "target_delay": 2}
GROUP, UPDATES, STEPS = 4, 8, WARMUP + 4


@pytest.mark.slow
def test_groups_make_the_same_operations():
    settings = dataclasses.replace(PLAIN, **DELAYS)
    method = find_method("ft1").make(SPEC, options("ft1", 0))
    learner = jax.jit(lambda key: sac.init(key, method, SPEC, settings))(
        jax.random.key(0)
    )
    size = settings.batch_size, SPEC.actions
    draws = jax.vmap(
        lambda key: sac.sample_update_noise(key, (), (), size, method, settings)
    )(jax.random.split(jax.random.key(1), UPDATES))
    numbers = jax.random.normal(jax.random.key(2), (UPDATES, size[0], 5))
    ended = jnp.zeros(numbers.shape[:2], bool)
    action, reward = jnp.tanh(numbers[..., 2:4]), numbers[..., 4]
    batches = Batch(numbers[..., :2], action, reward, ended, ended, numbers[..., 1:3])

    def batch(number):
        return jax.tree.map(lambda x: x[number], batches)

    def made(count, group):
        rest = method, settings, group
        return sac_updates.updates(learner, draws, batch, UPDATES, count, *rest)

    # One operation at a time: compiled together, they are rounded in other places.
    with jax.disable_jit():
        branches, groups, half = made(8, 1), made(8, GROUP), made(4, GROUP)
    equal(branches, groups)
    for one, other in zip(*map(jax.tree.leaves, (half, groups)), strict=True):
        assert not np.array_equal(one, other)


@pytest.fixture
def compiled(monkeypatch):
    """`group -> program` of FT-1, whatever the device."""

    def build(group):
        monkeypatch.setattr(sac_updates, "group_size", lambda *_: group)
        # Equal to no other, or the program of another group would be taken.
        make = functools.partial(find_method("ft1").make)
        shape = SHAPE._replace(updates=UPDATES)
        of = MemberFunctions(SCENARIO.environment, make, SPEC, shape)
        return compiled_functions.build(of, options("ft1", 0), MESH)

    return build


@pytest.mark.slow
def test_groups_are_compiled_without_branches(compiled):
    members = crowd()
    members = members._replace(sac=dataclasses.replace(members.sac, **DELAYS))
    made, branches = {}, {}
    for group in (1, GROUP):
        program = compiled(group)
        state = begin(program, members)
        lowered = program.chunk.lower(members, state, 0, TASKS[0], 0, STEPS)
        branches[group] = lowered.as_text().count("stablehlo.case")
        after, (report,) = go(program, members, state, [STEPS])
        made[group] = jax.tree.map(np.asarray, (after.learner, report))
    assert branches[1] - branches[GROUP] == 2
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5),
        *made.values(),
    )


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
