"""Cloning as an option of rewire, on small networks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.core.transition import Batch
from rewire_jax.methods.base import Tools
from rewire_jax.methods.rewire import rewire
from rewire_jax.methods.rewire_cloning import loss
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.methods.rewire_state import Context, Design
from tests.rewired import (
    ACTIONS,
    KEY,
    OBSERVATION,
    OBSERVATIONS,
    QUIET,
    SLOTS,
    SPEC,
    K,
    N,
    assert_same,
    head_at,
    make,
    play,
    selection,
    trained,
)

STATES = 8
CLONING = {"cloning": 3.0, "cloning_states": STATES, "dropout": 0.0}
METHOD, BARE = make(**CLONING), make()


def states(task):
    rng = np.random.default_rng(task)
    return rng.normal(size=(STATES, OBSERVATIONS)).astype(np.float32)


@jax.jit
def store(params, state, task, states):
    """What the method stores of a task with these states in its buffer."""

    def sample(key, count):
        del key
        assert count == len(states)
        return Batch(states, *[None] * 6)

    options = RewireSettings(modes=K, head_slots=SLOTS, **CLONING).checked()
    no_critic = Tools(sample, lambda *_: pytest.fail("no critic is needed"))
    method = rewire(SPEC, options)
    return method.consolidate(KEY, params, state, task, no_critic)


def after_tasks(number, returns=None):
    """In the middle of a task; `returns` of the modes at the end of the last one."""
    rng = np.random.default_rng(3)
    params, state = METHOD.init(KEY)
    for task in range(number):
        params, state = METHOD.start_task(KEY, params, state, task)
        params = trained(rng, params, task % SLOTS)
        params, state = store(params, state, task, states(task))
        last = task == number - 1 and returns is not None
        after, before = returns if last else (np.arange(K) + 1.0, 0.0)
        params, state = METHOD.end_task(params, state, task, selection(after, before))
    return METHOD.start_task(KEY, params, state, number)


@jax.jit
def cloning_loss(params, state):
    options = RewireSettings(modes=K, head_slots=SLOTS, **CLONING).checked()
    design = Design(SPEC, options, N, SLOTS, SLOTS, jnp.asarray(K))
    return loss(design, KEY, params, state)


def test_nothing_is_stored_without_it():
    params, state = BARE.init(KEY)
    assert rewire(SPEC, RewireSettings().checked()).consolidate is None
    assert state.memory == ()
    assert BARE.stored(params, state) == 0
    with_memory, other = METHOD.init(KEY)
    assert_same(with_memory, params)
    assert_same(other._replace(memory=()), state)


@pytest.mark.parametrize("failed", [False, True])
def test_what_is_stored_is_what_the_chosen_wiring_does(failed):
    # The best of the modes, or what was before the task that failed.
    params, state = after_tasks(2, ([1.0, 3.0, 2.0], 9.0 if failed else 0.0))
    np.testing.assert_array_equal(state.memory.observation[1], states(1))
    head = head_at(params, 1)
    expected = play(params.hidden, state.orders[1], head, states(1))
    got = state.memory.mean[1], state.memory.log_std[1]
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4)
    stored = 2 * STATES * (OBSERVATIONS + 2 * ACTIONS)
    assert METHOD.stored(params, state) == stored
    assert METHOD.size(params, state) == BARE.size(params, state)


def test_loss_against_numpy_by_the_refined_wiring():
    params, state = after_tasks(1)
    np.testing.assert_allclose(cloning_loss(params, state), 0, atol=1e-5)
    params = trained(np.random.default_rng(5), params)
    # One state alone, so that any draw has it.
    memory = jax.tree.map(lambda x: x.at[0].set(x[0, :1]), state.memory)
    state = state._replace(memory=memory)
    _, ended = BARE.end_task(params, state, 1, selection(np.ones(K)))
    assert not np.array_equal(ended.orders[0], state.orders[0])
    x, mean, log_std = (np.asarray(leaf[0, :1], np.float64) for leaf in memory)
    now, now_log_std = play(params.hidden, ended.orders[0], head_at(params, 0), x)
    variance, now_variance = np.exp(2 * log_std), np.exp(2 * now_log_std)
    each = np.log(now_variance / variance) + variance / now_variance - 1
    expected = (each + (mean - now) ** 2 / now_variance).sum() / 2
    assert expected > 0.01
    np.testing.assert_allclose(cloning_loss(params, state), expected, rtol=1e-3)


def test_it_trains_the_hidden_layers_alone():
    params, state = after_tasks(2)
    params = trained(np.random.default_rng(5), params)
    gradient = jax.grad(cloning_loss)(params, state)
    for leaf in jax.tree.leaves(gradient.hidden):
        assert np.abs(leaf).max() > 0
    others = gradient.heads, gradient.scores, gradient.adapters
    for leaf in jax.tree.leaves(others):
        np.testing.assert_array_equal(leaf, 0)


def test_it_is_added_to_the_other_losses():
    params, state = after_tasks(2)
    params = trained(np.random.default_rng(5), params)
    context = Context(0, 1, QUIET, KEY)
    gaussian = METHOD.distribution(params, state, context, OBSERVATION)
    value, metrics = METHOD.penalty(KEY, params, state, context, OBSERVATION, gaussian)
    bare, _ = BARE.penalty(KEY, params, state, context, OBSERVATION, gaussian)
    assert metrics["cloning"] > 0
    np.testing.assert_allclose(value - bare, 3 * metrics["cloning"], rtol=1e-3)


@pytest.mark.parametrize(
    "wrong",
    [
        {"cloning": 1.0},
        {"cloning": -1.0, "cloning_states": 5},
        {"cloning_states": -1},
        {"cloning_states": 5, "caching": False},
    ],
)
def test_settings_that_cannot_be(wrong):
    with pytest.raises(UserError, match="--cloning"):
        RewireSettings(**wrong).checked()
