"""The memory of cloning and its loss, against NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.methods import cloning
from rewire_jax.methods.spec import Spec

SPEC = Spec(observations=3, actions=2, hidden=5, depth=2, tasks=4)
KEY = jax.random.key(0)
SLOTS, STATES = 4, 6


def gaussian(shift, slot, observation):
    """A policy for each slot."""
    mean = observation[..., :2] * (1.0 + slot) + shift
    return mean, 0.1 * slot + 0.3 * observation[..., 1:] - shift


def filled(*slots, states=STATES):
    """A memory with what `gaussian` does without a shift in some slots; else NaN."""
    rng = np.random.default_rng(0)
    memory = jax.tree.map(
        lambda x: jnp.full_like(x, jnp.nan), cloning.empty(SPEC, SLOTS, states)
    )
    for slot in slots:
        observation = rng.normal(size=(states, 3)).astype(np.float32)
        memory = cloning.store_states(memory, slot, observation)
        memory = cloning.store_policy(
            memory, slot, functools.partial(gaussian, 0.0, slot)
        )
    return memory


@functools.partial(jax.jit, static_argnums=4)
def jitted(key, memory, earlier, shift, batch):
    policy = functools.partial(gaussian, shift)
    return cloning.loss(key, memory, earlier, batch, policy)


def loss(memory, slots, shift=0.0, batch=64, key=KEY):
    return jitted(key, memory, np.isin(np.arange(SLOTS), slots), shift, batch)


def numpy_kl(memory, slot, shift):
    """KL of each state of a slot, by the densities' ratio's closed form."""
    x, mean, log_std = (np.asarray(leaf[slot], np.float64) for leaf in memory)
    now, now_log_std = gaussian(shift, slot, x)
    variance, now_variance = np.exp(2 * log_std), np.exp(2 * now_log_std)
    each = np.log(now_variance / variance) + variance / now_variance - 1
    return (each + (mean - now) ** 2 / now_variance).sum(axis=-1) / 2


@pytest.mark.parametrize("slot", range(SLOTS))
def test_loss_against_numpy(slot):
    memory = filled(slot, states=1)
    (expected,) = numpy_kl(memory, slot, 0.4)
    assert expected > 0.1
    np.testing.assert_allclose(loss(memory, [slot], 0.4), expected, rtol=1e-5)
    np.testing.assert_allclose(loss(memory, [slot]), 0, atol=1e-6)


def test_states_and_slots_are_drawn_with_equal_probability():
    memory = filled(1, 3)
    expected = np.mean([numpy_kl(memory, slot, 0.4) for slot in (1, 3)])
    one = np.mean(numpy_kl(memory, 1, 0.4))
    assert abs(one - expected) > 0.1 * expected
    got = loss(memory, [1, 3], 0.4, batch=20_000)
    np.testing.assert_allclose(got, expected, rtol=0.03)
    assert loss(memory, [1, 3], 0.4) != loss(memory, [1, 3], 0.4, key=jax.random.key(1))


def test_other_slots_count_for_nothing():
    # All that is not drawn is NaN, which the loss and its gradient would show.
    value, gradient = jax.value_and_grad(
        lambda shift: loss(filled(2), [2], shift, batch=200)
    )(0.4)
    assert value > 0
    assert gradient > 0


def test_without_an_earlier_task_there_is_no_loss_and_no_gradient():
    memory = cloning.empty(SPEC, SLOTS, STATES)
    value, gradient = jax.value_and_grad(lambda shift: loss(memory, [], shift))(0.4)
    assert value == gradient == 0


@pytest.mark.parametrize(
    ("learned", "slots"),
    [(0, []), (1, [0]), (3, [0, 1, 2]), (4, [1, 2, 3]), (6, [0, 1, 3])],
)
def test_earlier_slots_are_filled_and_not_the_current_one(learned, slots):
    memory = cloning.empty(SPEC, SLOTS, STATES)
    earlier = cloning.earlier_slots(memory, jnp.asarray(learned))
    np.testing.assert_array_equal(np.flatnonzero(earlier), slots)
    numbers = min(learned, SLOTS) * STATES * (3 + 2 + 2)
    assert cloning.stored(memory, jnp.asarray(learned)) == numbers


def test_storing_replaces_one_slot():
    before = filled(0, 1, 2, 3)
    new = jnp.ones((STATES, 3))
    after = cloning.store_states(before, 1, new)
    after = cloning.store_policy(after, 1, functools.partial(gaussian, 0.5, 1))
    np.testing.assert_array_equal(after.observation[1], new)
    np.testing.assert_allclose(after.mean[1], 2.5)
    np.testing.assert_allclose(after.log_std[1], 0.1 + 0.3 - 0.5, rtol=1e-6)
    for old, now in zip(before, after, strict=True):
        assert not np.array_equal(old[1], now[1])
        others = np.array([0, 2, 3])
        np.testing.assert_array_equal(old[others], now[others])
