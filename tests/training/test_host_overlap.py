"""Steps of simulators while the updates are made."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.envs.vector_env import VectorEnv
from rewire_jax.methods import find_method
from rewire_jax.training import exploration
from tests import walk
from tests.walk_loop import EVERY, begin, go, planned

pytestmark = pytest.mark.usefixtures("one_core")


def test_with_overlap_the_policy_before_the_last_updates_acts():
    plan = planned(walk.walker(0.5), overlap=True, random_interactions=0)
    states = [begin(plan)]
    for number in range(5):
        state, _ = go(plan, states[-1], [EVERY], time=EVERY * number)
        states.append(state)
    final = states[-1].collection.buffer
    member = jax.tree.map(lambda x: x[0], plan.stacked)
    key = jax.random.split(jax.random.fold_in(jax.random.fold_in(member.keys, 1), 0), 4)
    method = find_method("ft1").make(plan.spec, plan.settings.options)

    def acted(learner, time):
        step_key = jax.random.split(jax.random.fold_in(key[1], time))[0]
        action, _ = exploration.explore(
            exploration.sample_action_noise(
                step_key, jnp.asarray(time), (1, 2), 0, None
            ),
            jax.tree.map(lambda x: x[0], (learner.params, learner.method_state)),
            (),
            final.observation[0, time],
            jnp.zeros(1, jnp.int32),
            method,
        )
        return action

    for number in (2, 3, 4):
        time = EVERY * number
        before, newest = states[number - 1].learner, states[number].learner
        mine = final.action[0, time]
        np.testing.assert_allclose(acted(before, time), mine, rtol=1e-4, atol=1e-5)
        if number > 2:  # by then there were updates between the two
            assert abs(acted(newest, time) - mine).max() > 1e-4
    plain = planned(walk.walker(0.5), random_interactions=0)
    state, _ = go(plain, begin(plain), [5 * EVERY])
    assert (state.collection.buffer.action[0, 16:20] != final.action[0, 16:20]).any()


def test_with_overlap_steps_and_updates_are_made_at_the_same_time(monkeypatch):
    """A simulator that waits for an update to be begun, and an update for its steps."""
    plan = planned(walk.walker(), overlap=True, interactions=80)
    state = begin(plan)
    state, _ = go(plan, state, [8])  # all is compiled
    submitted, stepped = [], []
    submit, step = ThreadPoolExecutor.submit, VectorEnv.step
    held = threading.Event()

    def slow_submit(self, function, *arguments):
        def held_back():
            # The updates are not begun before steps that need not wait for them.
            assert held.wait(60)
            return function(*arguments)

        submitted.append(len(stepped))
        held.clear()
        return submit(self, held_back)

    def counted(self, actions):
        stepped.append(len(submitted))
        if len(stepped) % EVERY == 0:
            held.set()
        return step(self, actions)

    monkeypatch.setattr(ThreadPoolExecutor, "submit", slow_submit)
    monkeypatch.setattr(VectorEnv, "step", counted)
    threading.Timer(30, held.set).start()
    began = time.monotonic()
    done = threading.Thread(target=go, args=(plan, state, [12]), kwargs={"time": 8})
    done.start()
    while len(stepped) < 3 * EVERY and time.monotonic() - began < 25:
        time.sleep(0.01)
    # All steps were made, though no update had been let through before its next ones.
    assert len(stepped) == 3 * EVERY
    held.set()
    done.join()
    assert submitted == [EVERY, 2 * EVERY, 3 * EVERY]


def test_overlap_needs_something_to_overlap():
    with pytest.raises(UserError, match="--overlap"):
        planned(walk.COMPILED, overlap=True)
