"""What the rewiring method draws for an action or an update: mode, noise, dropout."""

import functools

import jax
import numpy as np
import pytest

from rewire_jax.methods.rewire import rewire
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.methods.rewire_state import Context
from tests.rewired import (
    ACTIONS,
    DEPTH,
    FLAT,
    KEY,
    OBSERVATION,
    OBSERVATIONS,
    SPEC,
    K,
    N,
    head_at,
    make,
)


@functools.partial(jax.jit, static_argnames=("number", "purpose"))
def contexts(options, number, purpose):
    method = rewire(SPEC, options)
    _, state = method.init(KEY)
    draw = jax.vmap(lambda key: method.context(key, state, purpose, ()))
    return draw(jax.random.split(KEY, number))


@pytest.mark.parametrize("purpose", ["act", "critic", "policy"])
def test_modes_are_uniform(purpose):
    for modes in (1, 3, 4):
        options = RewireSettings(modes=modes, mode_slots=5)
        drawn = contexts(options, number=4000, purpose=purpose)
        assert drawn.mode.shape == (4000,)  # one for all layers
        counts = np.bincount(drawn.mode, minlength=5)
        np.testing.assert_array_equal(counts[modes:], 0)
        error = 5 * np.sqrt(4000 / modes)
        np.testing.assert_allclose(counts[:modes], 4000 / modes, atol=error)
        # Every other mode comes up with it, about equally often.
        others = max(modes - 1, 1)
        offsets = np.bincount((drawn.other - drawn.mode) % modes, minlength=modes)
        np.testing.assert_allclose(
            offsets[-others:], 4000 / others, atol=5 * np.sqrt(4000 / others)
        )


def test_each_environment_holds_a_mode_of_its_own():
    every, envs = 4, 3000
    method = make(mode_steps=every, mode_slots=5)
    _, state = method.init(KEY)
    steps = np.arange(envs) % 7  # they are at different places of their episodes
    held = np.asarray(method.extras(KEY, state, None, steps))
    for number in range(9):
        key = jax.random.fold_in(KEY, number)
        following = np.asarray(method.extras(key, state, held, steps))
        draws = steps % every == 0
        np.testing.assert_array_equal(following[~draws], held[~draws])
        # A draw is uniform, independent of the mode before and of other environments.
        pairs = np.bincount(K * held[draws] + following[draws], minlength=K * K)
        even = draws.sum() / K**2
        np.testing.assert_allclose(pairs, even, atol=5 * np.sqrt(even))
        held, steps = following, np.where(steps == 6, 0, steps + 1)


def test_an_environment_acts_by_the_mode_it_holds():
    method, rng = make(mode_steps=4, mode_slots=5), np.random.default_rng(3)
    params, state = method.init(KEY)
    params = params._replace(scores=rng.normal(size=params.scores.shape))
    modes = np.array([2, 0, 1, 1, 0, 2, 2])
    for purpose in ("critic", "policy"):  # updates draw one mode for the batch
        assert np.shape(method.context(KEY, state, purpose, modes).mode) == ()
    context = method.context(KEY, state, "act", modes)
    mean, log_std = method.distribution(params, state, context, OBSERVATION)
    policies = method.candidates(params, state, 0).policies
    for place, mode in enumerate(modes):
        own = jax.tree.map(lambda x, mode=mode: x[mode], policies)
        expected = method.act(own, OBSERVATION[place])
        np.testing.assert_allclose((mean[place], log_std[place]), expected, rtol=1e-5)


def test_noise_is_gumbel_and_only_in_learning():
    loud, quiet = (RewireSettings(mode_slots=5, noise=noise) for noise in (0.3, 0.0))
    assert np.all(np.asarray(contexts(loud, number=4000, purpose="act").noise) == 0)
    assert np.all(np.asarray(contexts(quiet, number=4000, purpose="policy").noise) == 0)
    noise = np.float64(contexts(loud, number=4000, purpose="policy").noise)
    assert noise.shape == (4000, DEPTH, N)
    # Its distribution function is exp(-exp(-x)).
    uniform = np.sort(np.exp(-np.exp(-noise.ravel() / 0.3)))
    even = (np.arange(uniform.size) + 0.5) / uniform.size
    assert np.max(np.abs(uniform - even)) < 2 / np.sqrt(uniform.size)
    correlation = np.corrcoef(noise.reshape(4000, -1).T) - np.eye(DEPTH * N)
    assert np.max(np.abs(correlation)) < 0.1


def test_dropout_has_its_rate_and_keeps_the_mean():
    # One layer, where LeakyReLU passes the factor of a kept neuron through.
    rate, number = 0.25, 4000
    method = make(FLAT, dropout=rate)
    params, state = method.init(KEY)
    context = Context(0, 0, np.zeros((1, N), np.float32), jax.random.split(KEY, number))
    draw = jax.vmap(
        method.distribution, (None, None, Context(None, None, None, 0), None)
    )
    means = np.asarray(draw(params, state, context, OBSERVATION)[0], np.float64)
    (weight, bias), head = params.hidden[0], head_at(params, 0)
    x = OBSERVATION @ weight.T + bias
    terms = np.where(x > 0, x, 0.2 * x)[:, :, None] * head.weight.T[None, :, :ACTIONS]
    expected = terms.sum(axis=1) + head.bias[:ACTIONS]
    variance = rate / (1 - rate) * np.sum(np.square(terms), axis=1)
    error = np.sqrt(variance / number)
    assert np.all(np.abs(means.mean(axis=0) - expected) < 5 * error)
    np.testing.assert_allclose(means.var(axis=0), variance, rtol=0.2)
    # Every state of a batch has its own mask.
    same = np.broadcast_to(OBSERVATION[:1], (50, OBSERVATIONS))
    one = Context(0, 0, np.zeros((1, N), np.float32), KEY)
    assert np.unique(method.distribution(params, state, one, same)[0]).size > 50
