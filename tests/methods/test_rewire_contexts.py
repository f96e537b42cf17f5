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
