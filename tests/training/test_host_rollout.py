"""Evaluation of policies in simulators."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.methods import find_method
from tests import walk
from tests.walk_loop import planned

pytestmark = pytest.mark.usefixtures("one_core")


def test_rollouts_are_those_of_a_loop():
    environment = walk.walker(0.9)
    plan = planned(environment, seeds=2, seed=4)
    learner = plan.program.init(plan.stacked)
    # Policies that reach the goals, and run over the edge on the way to some.
    policies = plan.program.policies(plan.stacked, learner)
    policies = jax.tree.map(lambda x: 4 * x, policies)
    keys = jax.random.split(jax.random.key(5), (2, 2))
    count = 5  # for two lanes: the last wave has one to spare
    result = plan.program.rollout(plan.tasks, policies, keys, count)
    method = find_method("ft1").make(plan.spec, plan.settings.options)
    simulator = environment.make()
    for m, row, e in itertools.product(range(2), range(2), range(count)):
        task = walk.TASKS[row]
        words = [*np.asarray(jax.random.key_data(keys[m, row])), e]
        seed = int(np.random.SeedSequence(words).generate_state(1)[0])
        seen, _ = simulator.reset(seed=seed, options={"task": row})
        policy = jax.tree.map(lambda x, m=m, row=row: x[m, row], policies)
        total, solved, terminal, steps = 0.0, [], False, 0
        while steps < walk.LENGTH and not terminal:
            mean, _ = method.act(policy, seen * task.observation_mask)
            action = np.asarray(jnp.tanh(mean) * task.action_scale)
            seen, reward, terminal, _, info = simulator.step(action)
            total, steps = total + reward, steps + 1
            solved.append(info["success"])
        at = m, row, e
        np.testing.assert_allclose(result.returns[at], total, rtol=1e-4)
        assert result.lengths[at] == steps
        assert result.success.any[at] == any(solved)
        assert result.success.last[at] == solved[-1]
    assert 0 < result.success.any.sum() < result.success.any.size
    assert (result.lengths < walk.LENGTH).any()
