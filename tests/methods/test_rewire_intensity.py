"""The scores' unit and rate, the intensity, and matching within the method."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax import make_train
from rewire_jax.methods.rewire_state import Context
from rewire_jax.methods.round import Round
from rewire_jax.nn.networks import Linear
from tests.rewired import (
    DEPTH,
    KEY,
    OBSERVATION,
    QUIET,
    SPEC,
    K,
    N,
    after_tasks,
    assert_near,
    assert_same,
    make,
    orders_of,
    selection,
    trained,
)
from tests.tiny import tiny

UPDATES = SPEC._replace(updates=200)


def made(before, after, temperature=0.5):
    return Round(jnp.asarray(before), jnp.asarray(after), {"temperature": temperature})


# Score rate and unit


def test_the_score_rate_multiplies_the_scores_step_alone():
    params, state = make().init(KEY)
    updates = jax.tree.map(jnp.ones_like, params)
    got = make(score_rate=0.25).adjust_updates(updates, state)
    assert_same(got, updates._replace(scores=K * 0.25 * updates.scores))


def test_neighbours_are_one_apart_and_all_else_is_as_in_the_other_unit():
    unit = N - 1
    plain = make(noise=0.05, tau=0.3)
    scaled = make(noise=0.05 * unit, tau=0.3 * unit, score_unit="neighbour")
    params, state = plain.init(KEY)
    other, other_state = scaled.init(KEY)
    np.testing.assert_allclose(np.diff(np.sort(other.scores)), 1, rtol=1e-5)
    assert_same(other.hidden, params.hidden)
    params = trained(np.random.default_rng(0), params)
    other = params._replace(scores=params.scores * unit)
    draw = jax.random.key(3)
    context = plain.context(draw, state, "policy", ())
    noisy = scaled.context(draw, other_state, "policy", ())
    np.testing.assert_allclose(noisy.noise, context.noise * unit, rtol=1e-6)

    def loss(method, state, context):
        def of(params):
            mean, log_std = method.distribution(params, state, context, OBSERVATION)
            return jnp.sum(mean**2) + jnp.sum(log_std)

        return jax.value_and_grad(of)

    value, gradient = loss(plain, state, context)(params)
    value_2, gradient_2 = loss(scaled, other_state, noisy)(other)
    np.testing.assert_allclose(value, value_2, rtol=1e-5)
    assert np.any(gradient.scores != 0)
    np.testing.assert_allclose(
        gradient.scores, gradient_2.scores * unit, rtol=1e-3, atol=1e-4
    )
    # A task's end and the next one's start space the scores evenly again.
    done, kept = scaled.end_task(other, other_state, 0, selection([1, 3, 2]))
    began, _ = scaled.start_task(KEY, done, kept, 1)
    for scores in (done.scores, began.scores):
        np.testing.assert_array_equal(orders_of(scores), [kept.orders[0]] * K)
        np.testing.assert_allclose(
            np.sort(scores), np.broadcast_to(np.arange(N), scores.shape), rtol=1e-6
        )


# Intensity


def test_a_constant_intensity_stays():
    method = make()
    params, state = method.init(KEY)
    assert_same(method.after_round(params, state, made(0, 100)), (params, state))
    assert state.intensity == 1


@pytest.mark.parametrize(("after", "share"), [(0, 1), (25, 0.75), (50, 0.5), (150, 0)])
def test_a_linear_intensity_ends_with_its_share_of_the_task(after, share):
    method = make(UPDATES, intensity="linear", anneal=0.5)
    params, state = method.init(KEY)
    same, state = method.after_round(params, state, made(after - 1, after))
    assert_same(same, params)
    np.testing.assert_allclose(state.intensity, share, atol=1e-6)
    # Noise and steps of the scores fall with it, the adapters' steps do not.
    loud = make(UPDATES).context(KEY, state._replace(intensity=1.0), "policy", ())
    quiet = method.context(KEY, state, "policy", ())
    np.testing.assert_allclose(quiet.noise, share * loud.noise, atol=1e-7)
    updates = jax.tree.map(jnp.ones_like, params)
    got = method.adjust_updates(updates, state)
    np.testing.assert_allclose(got.scores, K * share * updates.scores, atol=1e-6)
    assert_same(got.adapters, updates.adapters)
    # The next task begins with all of it.
    _, state = method.start_task(KEY, params, state, 1)
    assert state.intensity == 1


def test_an_intensity_by_temperature_is_relative_to_the_highest_of_the_task():
    method = make(intensity="temperature")
    params, state = method.init(KEY)
    temperatures = [0.0, 0.2, 0.1, 0.4, 0.1, 0.3]
    expected = [1, 1, 0.5, 1, 0.25, 0.75]
    for number, (now, share) in enumerate(zip(temperatures, expected, strict=True)):
        _, state = method.after_round(params, state, made(number, number + 1, now))
        np.testing.assert_allclose(state.intensity, share, rtol=1e-6)
    _, state = method.start_task(KEY, params, state, 1)
    _, state = method.after_round(params, state, made(0, 1, 0.05))
    assert state.intensity == 1


# Matching


def swapped(hidden):
    """The layers with two rows of the last one exchanged."""
    order = np.arange(N)
    order[[2, 5]] = [5, 2]
    last = hidden[-1]
    return (*hidden[:-1], Linear(last.weight[order], last.bias[order])), order


def test_matching_is_solved_when_its_updates_have_passed():
    method = make(alignment="matching", match_every=100)
    params, state = after_tasks(method, 1, np.random.default_rng(1))
    hidden, order = swapped(params.hidden)
    moved = params._replace(hidden=hidden)
    for before, after, due in ((0, 8, False), (92, 99, False), (96, 104, True)):
        got, same = method.after_round(moved, state, made(before, after))
        wanted = order if due else np.arange(N)
        np.testing.assert_array_equal(orders_of(got.adapters.out[-1]), wanted)
        assert_same(same, state)


def test_matching_pulls_weights_to_the_matched_ones_and_trains_no_adapter():
    method = make(alignment="matching", beta=1.0, alpha=0.0)
    params, state = after_tasks(method, 1, np.random.default_rng(2))
    hidden, _ = swapped(params.hidden)
    moved, _ = method.after_round(
        params._replace(hidden=hidden), state, made(999, 1000)
    )
    further = jax.tree.map(lambda x: x + 0.1, moved.hidden)
    context = Context(jnp.asarray(0), jnp.asarray(1), QUIET, KEY)

    def penalty(params):
        gaussian = method.distribution(params, state, context, OBSERVATION)
        return method.penalty(KEY, params, state, context, OBSERVATION, gaussian)[0]

    assert penalty(moved) == 0
    value, gradient = jax.value_and_grad(penalty)(moved._replace(hidden=further))
    numbers = sum(x.size for x in jax.tree.leaves(further))
    np.testing.assert_allclose(value, 0.01 * numbers, rtol=1e-4)
    jax.tree.map(
        lambda g: np.testing.assert_allclose(g, 0.2, rtol=1e-3), gradient.hidden
    )
    for leaf in jax.tree.leaves((gradient.adapters, gradient.scores)):
        np.testing.assert_array_equal(leaf, 0)


def test_cached_policies_survive_a_permutation_that_matching_must_find():
    method, rng = make(alignment="matching"), np.random.default_rng(3)
    params, state = after_tasks(method, 2, rng)
    before = [method.act(method.policy(params, state, t), OBSERVATION) for t in (0, 1)]
    began, state = method.start_task(KEY, params, state, 2)
    rows = np.random.default_rng(4).permuted(np.tile(np.arange(N), (DEPTH, 1)), axis=1)
    moved = tuple(
        Linear(np.asarray(weight)[z], np.asarray(bias)[z])
        for (weight, bias), z in zip(params.hidden, rows, strict=True)
    )
    changed = trained(rng, began, slot=2)._replace(
        hidden=moved, adapters=began.adapters
    )
    done, kept = method.end_task(changed, state, 2, selection([1, 3, 2]))
    assert np.any(kept.orders[:2] != state.orders[:2])
    for task, wanted in enumerate(before):
        played = method.act(method.policy(done, kept, task), OBSERVATION)
        assert_near(played, wanted)


@pytest.mark.slow
def test_a_run_matches_and_ends_at_rest():
    settings = dataclasses.replace(tiny(), tasks=2)
    options = dataclasses.replace(
        settings.options,
        alignment="matching",
        match_every=20,
        beta=1.0,
        intensity="linear",
    )
    settings = dataclasses.replace(settings, options=options)
    train = make_train(settings)
    sweep = jax.vmap(
        lambda key, anneal: train(
            key, options=dataclasses.replace(options, anneal=anneal)
        ),
        (None, 0),
    )
    made = jax.jit(sweep)(jax.random.key(0), jnp.asarray([0.25, 0.5, 1.0]))
    assert np.all(made.active)
    np.testing.assert_allclose(made.learned.method_state.intensity, 0, atol=1e-6)
    # The first part of a task, with other noise, makes another policy.
    assert len(np.unique(made.returns[:, 1, 0])) == 3
    orders = np.sort(made.learned.method_state.orders, axis=-1)
    np.testing.assert_array_equal(orders, np.broadcast_to(np.arange(16), orders.shape))
