import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.methods import wiring
from rewire_jax.methods.base import Selection
from rewire_jax.methods.rewire import rewire
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.methods.rewire_state import Context
from rewire_jax.nn.networks import Linear
from tests.rewired import (
    ACTIONS,
    DEPTH,
    FLAT,
    KEY,
    OBSERVATION,
    QUIET,
    SLOTS,
    SPEC,
    TASKS,
    K,
    N,
    after_tasks,
    assert_near,
    assert_same,
    evenly_in,
    head_at,
    make,
    orders_of,
    play,
    selection,
    trained,
)

# The end of a task


def test_the_best_mode_is_cached_and_spread():
    method, rng = make(), np.random.default_rng(7)
    params, state = method.init(KEY)
    params, state = method.start_task(KEY, params, state, 0)
    params = trained(rng, params)
    for best in range(K):
        after = np.full(K, -5.0)
        after[best] = -1.0
        done, kept = method.end_task(params, state, 0, selection(after))
        orders = orders_of(params.scores[best])
        np.testing.assert_array_equal(kept.orders[0], orders)
        np.testing.assert_allclose(
            done.scores, np.tile(evenly_in(orders), (K, 1, 1)), rtol=1e-6
        )
        assert_same(done.hidden, params.hidden)
        assert_same(done.heads, params.heads)
        assert_same(kept.previous, params.hidden)
        assert kept.learned == 1
        assert kept.orders.dtype == state.orders.dtype == jnp.int32
        # What is played is what was learned in the kept mode.
        played = method.act(method.policy(done, kept, 0), OBSERVATION)
        context = Context(best, 0, QUIET, KEY)
        wanted = method.distribution(params, state, context, OBSERVATION)
        assert_near(played, wanted)
        candidates = method.candidates(params, state, 0)
        assert np.all(candidates.valid)
        one = jax.tree.map(lambda leaf, k=best: leaf[k], candidates.policies)
        assert_near(method.act(one, OBSERVATION), wanted)


def test_without_selection_the_first_mode_is_kept():
    method, rng = make(), np.random.default_rng(8)
    params, state = method.init(KEY)
    params = trained(rng, params)
    _, state = method.end_task(params, state, 0, None)
    np.testing.assert_array_equal(state.orders[0], orders_of(params.scores[0]))


def test_the_authors_choose_no_mode_after_the_first_task():
    method, rng = make(select_first=False), np.random.default_rng(8)
    params, state = method.init(KEY)
    assert not np.any(method.candidates(params, state, 0).valid)
    params = trained(rng, params)
    # Zeros, since nothing was played; even if something was, it counts for nothing.
    for after in ([0.0] * K, [-5.0] * (K - 1) + [9.0]):
        _, kept = method.end_task(params, state, 0, selection(after))
        np.testing.assert_array_equal(kept.orders[0], orders_of(params.scores[0]))
    # Later on they do.
    params, state = method.start_task(KEY, params, kept, 1)
    assert np.all(method.candidates(params, state, 1).valid)
    params = trained(rng, params)
    _, kept = method.end_task(params, state, 1, selection([1.0] * (K - 1) + [9.0]))
    np.testing.assert_array_equal(kept.orders[1], orders_of(params.scores[K - 1]))


def test_the_first_task_is_never_undone():
    method, rng = make(), np.random.default_rng(9)
    params, state = method.init(KEY)
    changed = trained(rng, params)
    worse = selection([-9.0, -8.0, -9.5], before=100.0)
    done, state = method.end_task(changed, state, 0, worse)
    assert_same(done.hidden, changed.hidden)
    assert_same(done.heads, changed.heads)
    np.testing.assert_array_equal(state.orders[0], orders_of(changed.scores[1]))


@pytest.mark.parametrize("task", [1, 2, 3, 4])
def test_roll_back(task):
    # Task 1 has a fresh slot; tasks 3 and 4 come to theirs for the second time.
    method, rng = make(), np.random.default_rng([10, task])
    params, state = after_tasks(method, task, rng)
    began, at_start = method.start_task(KEY, params, state, task)
    changed = trained(rng, began, task % SLOTS)
    worse = selection([0.9, 0.8, -3.0], before=1.0)
    done, kept = method.end_task(changed, at_start, task, worse)
    assert_same(done, began)
    slot = task % SLOTS
    orders = np.array(state.orders)
    orders[slot] = orders_of(began.scores[0])
    np.testing.assert_array_equal(kept.orders, orders)
    assert_same(kept.previous, state.previous)
    assert kept.learned == task + 1
    wanted = method.distribution(
        began, at_start, Context(0, 0, QUIET, KEY), OBSERVATION
    )
    assert_near(method.act(method.policy(done, kept, task), OBSERVATION), wanted)

    # As good as before is good enough.
    equal = selection([1.0, 0.8, -3.0], before=1.0)
    done, kept = method.end_task(changed, at_start, task, equal)
    assert_same(done.hidden, changed.hidden)
    np.testing.assert_array_equal(kept.orders[slot], orders_of(changed.scores[0]))


def test_before_is_the_mean_of_the_valid_candidates():
    # They are one policy played K times; the best of them is no fair measure.
    method, rng = make(mode_slots=5), np.random.default_rng(11)
    params, state = after_tasks(method, 1, rng)
    began, state = method.start_task(KEY, params, state, 1)
    changed = trained(rng, began)
    before = np.float32([1, 2, 3, 100, -100])
    for best, failed in ((2.1, False), (1.9, True)):
        after = np.float32([0.0, best, 1.0, 50.0, 60.0])
        done, _ = method.end_task(changed, state, 1, Selection(before, after))
        assert_same(done.hidden, began.hidden if failed else changed.hidden)


def test_a_return_that_is_no_number_never_wins():
    method, rng = make(), np.random.default_rng(12)
    params, state = after_tasks(method, 1, rng)
    began, state = method.start_task(KEY, params, state, 1)
    changed = trained(rng, began)
    result = selection([np.nan, 1.0, 2.0])
    _, kept = method.end_task(changed, state, 1, result)
    np.testing.assert_array_equal(kept.orders[1], orders_of(changed.scores[2]))
    done, _ = method.end_task(changed, state, 1, selection([np.nan] * 3))
    assert_same(done.hidden, began.hidden)


def test_refinement_comes_before_the_new_order():
    method, rng = make(), np.random.default_rng(13)
    params, state = method.init(KEY)
    first = trained(rng, params)
    done, kept = method.end_task(first, state, 0, selection([1, 2, 3]))
    # Before the first task nothing was cached, and adapters mean nothing.
    np.testing.assert_array_equal(kept.orders[1:], state.orders[1:])

    began, state = method.start_task(KEY, done, kept, 1)
    changed = trained(rng, began)
    done, kept = method.end_task(changed, state, 1, selection([1, 3, 2]))
    refined = wiring.refine(state.orders, changed.adapters)
    assert np.any(refined[0] != state.orders[0])
    np.testing.assert_array_equal(kept.orders[0], refined[0])
    # The new order belongs to the new weights already.
    np.testing.assert_array_equal(kept.orders[1], orders_of(changed.scores[1]))
    assert_same(done.adapters, wiring.identity_adapters(DEPTH, N))

    # Adapters that learned nothing leave the cache alone.
    began, state = method.start_task(KEY, done, kept, 2)
    _, kept = method.end_task(
        trained(rng, began)._replace(adapters=began.adapters), state, 2, None
    )
    np.testing.assert_array_equal(kept.orders[:2], state.orders[:2])


def test_policies_survive_a_permutation_of_the_weights():
    # W = P' W_prev P''^T through a whole task: all cached policies come back.
    method, rng = make(), np.random.default_rng(14)
    params, state = after_tasks(method, 2, rng)
    before = [method.act(method.policy(params, state, t), OBSERVATION) for t in (0, 1)]
    began, state = method.start_task(KEY, params, state, 2)
    changed = trained(rng, began, slot=2)
    out, inp = (orders_of(scores) for scores in changed.adapters)
    moved = []
    for index, (weight, bias) in enumerate(params.hidden):
        weight = np.asarray(weight)[out[index]]
        if index:
            weight = weight[:, inp[index - 1]]
        moved.append(Linear(weight, np.asarray(bias)[out[index]]))
    changed = changed._replace(hidden=tuple(moved))
    done, kept = method.end_task(changed, state, 2, selection([1, 3, 2]))
    assert np.any(kept.orders[:2] != state.orders[:2])
    for task, wanted in enumerate(before):
        played = method.act(method.policy(done, kept, task), OBSERVATION)
        assert_near(played, wanted)
    played = method.act(method.policy(done, kept, 2), OBSERVATION)
    head = head_at(changed, 2)
    assert_near(played, play(moved, orders_of(changed.scores[1]), head))


def test_policies_survive_a_task_that_leaves_the_weights():
    method, rng = make(), np.random.default_rng(15)
    params, state = after_tasks(method, 2, rng)
    before = [method.act(method.policy(params, state, t), OBSERVATION) for t in (0, 1)]
    assert not np.allclose(before[0][0], before[1][0], atol=0.01)
    began, state = method.start_task(KEY, params, state, 2)
    changed = trained(rng, began, slot=2, hidden=False)
    changed = changed._replace(adapters=began.adapters)
    done, kept = method.end_task(changed, state, 2, selection([1, 3, 2]))
    for task, wanted in enumerate(before):
        played = method.act(method.policy(done, kept, task), OBSERVATION)
        assert_same(played, wanted)


# Slots


def test_a_task_starts_from_the_latest_or_its_own():
    method, rng = make(), np.random.default_rng(16)
    params, state = method.init(KEY)
    for task in range(TASKS):
        source = task % SLOTS if task >= SLOTS else max(task - 1, 0)
        began, at_start = method.start_task(KEY, params, state, task)
        assert_same(began.hidden, params.hidden)
        assert_same(head_at(began, task % SLOTS), head_at(params, source))
        assert_same(at_start.head, head_at(params, source))
        assert_same(at_start._replace(head=0), state._replace(head=0))
        expected = evenly_in(np.asarray(state.orders[source]))
        np.testing.assert_allclose(
            began.scores, np.tile(expected, (K, 1, 1)), rtol=1e-6
        )
        assert_same(began.adapters, wiring.identity_adapters(DEPTH, N))
        # The head in use is the task's own.
        context = Context(0, 0, QUIET, KEY)
        wanted = play(
            began.hidden, orders_of(began.scores[0]), head_at(began, task % SLOTS)
        )
        got = method.distribution(began, at_start, context, OBSERVATION)
        assert_near(got, wanted)
        params = trained(rng, began, task % SLOTS)
        params, state = method.end_task(
            params, at_start, task, selection(rng.permutation(K) + 1.0)
        )
        for other in range(SLOTS):
            if other != task % SLOTS:
                assert_same(head_at(params, other), head_at(began, other))


@pytest.mark.parametrize("learned", range(TASKS + 1))
def test_which_policy_a_task_gets(learned):
    method, rng = make(), np.random.default_rng([17, learned])
    params, state = after_tasks(method, learned, rng)
    for task in range(TASKS):
        slot = task % SLOTS
        if slot >= learned:  # not seen, not even in an earlier round
            slot = max(learned - 1, 0)
        wanted = play(params.hidden, state.orders[slot], head_at(params, slot))
        got = method.act(method.policy(params, state, task), OBSERVATION)
        assert_near(got, wanted)


def test_there_are_no_more_slots_than_tasks():
    spec = SPEC._replace(tasks=2)
    params, state = make(spec, head_slots=4).init(KEY)
    assert params.heads.bias.shape == (2, 2 * ACTIONS)
    assert state.orders.shape == (2, DEPTH, N)


# Populations


def live(params, state, shift, result, modes):
    """A task with a gradient step, in as many places as `shift` has."""
    options = RewireSettings(
        mode_slots=len(shift), head_slots=SLOTS, alpha=0.1, dropout=0.2
    )
    method = rewire(FLAT, dataclasses.replace(options, modes=modes))
    params, state = method.start_task(KEY, params, state, 1)
    params = params._replace(
        scores=params.scores + shift,
        hidden=jax.tree.map(lambda x: 1.1 * x, params.hidden),
    )
    context = method.context(KEY, state, "policy", ())

    def loss(params):
        gaussian = method.distribution(params, state, context, OBSERVATION)
        penalty, metrics = method.penalty(
            KEY, params, state, context, OBSERVATION, gaussian
        )
        return jnp.sum(gaussian[0]) + penalty, (gaussian, metrics)

    losses, gradient = jax.value_and_grad(loss, has_aux=True)(params)
    updates = method.adjust_updates(gradient, state)
    params = jax.tree.map(lambda p, u: p - 0.01 * u, params, updates)
    candidates = method.candidates(params, state, 1)
    outcome = Selection(result - 1, result)
    params, state = method.end_task(params, state, 1, outcome)
    policy = method.policy(params, state, 1)
    size = method.size(params, state)
    drawn = context.mode, context.noise
    return losses, updates, drawn, candidates, params, state, policy, size


@pytest.mark.slow  # for the time its programs take to compile
def test_spare_places_change_nothing():
    # K = 3 beside K = 2 in five places, against itself alone in three.
    rng = np.random.default_rng(19)
    shift = rng.normal(size=(5, 1, N)).astype(np.float32)
    # The spare places have the best returns: they must not be chosen.
    result = np.arange(5, dtype=np.float32)
    params, state = make(FLAT).init(KEY)
    state = state._replace(learned=jnp.asarray(1))
    wide = params._replace(scores=np.concatenate([params.scores, shift[K:]]))
    over_modes = jax.jit(jax.vmap(live, (None, None, None, None, 0)))
    together = over_modes(wide, state, shift, result, np.array([2, K]))
    alone = jax.jit(live)(params, state, shift[:K], result[:K], K)

    def compare(a, b):
        a = np.asarray(a[1])
        if a.shape != b.shape:  # the axis of modes
            assert len(a) == 5
            a = a[:K]
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)

    jax.tree.map(compare, together, alone)
    _, updates, (mode, _), candidates, _, state, _, _ = together
    for index, modes in enumerate((2, K)):
        np.testing.assert_array_equal(candidates.valid[index], np.arange(5) < modes)
        learned = np.any(np.asarray(updates.scores[index]) != 0, axis=(1, 2))
        np.testing.assert_array_equal(learned, np.arange(5) == mode[index])
    assert np.any(state.orders[0, 1] != state.orders[1, 1])
