import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.pytrees import count
from rewire_jax.methods.base import Tools
from rewire_jax.nn.networks import Linear
from tests.csp_parts import (
    KEY,
    OBSERVATIONS,
    SEARCH,
    TASKS,
    assert_dirichlet,
    assert_near,
    assert_on_simplex,
    assert_same,
    batch_of,
    folded,
    in_training,
    make,
    random_weights,
    selection,
)


@pytest.mark.parametrize("frozen", [1, 3])
def test_the_search_proposes_the_best_of_either_simplex(frozen):
    rng = np.random.default_rng(6)
    method, params, state, _ = in_training(rng, frozen)
    slope = rng.normal(size=TASKS).astype(np.float32)
    weights, noise = [], []

    def sample(key, number):
        return batch_of(jax.random.normal(key, (number, OBSERVATIONS)))

    def q(context, observation, action):
        weights.append(context)
        jax.debug.callback(noise.append, observation[:, 0])
        value = context @ slope + observation[:, 0]
        return jnp.stack([value, -100 * value])

    kept, state = method.consolidate(KEY, params, state, frozen, Tools(sample, q))
    jax.effects_barrier()
    assert_same(kept, params)
    assert len(noise) == SEARCH["estimations"]
    assert len(np.unique(noise)) > SEARCH["samples"] * SEARCH["estimations"]
    drawn = np.asarray(weights[0])
    value = drawn @ slope + np.mean(noise, axis=0)
    halves = np.split(np.arange(len(value)), 2)
    best = [half[np.argsort(-value[half])[:2]] for half in halves]
    np.testing.assert_array_equal(state.proposals, drawn[np.concatenate(best)])
    for half, used in zip(halves, (frozen + 1, frozen), strict=True):
        assert len(half) == SEARCH["samples"]
        assert_on_simplex(drawn[half], used)
    assert np.all(drawn[halves[0]][:, frozen] > 0)


def test_the_search_draws_flatly():
    method, params, state, _ = in_training(
        np.random.default_rng(7), 2, samples=4000, estimations=1, distribution="peaked"
    )
    seen = []

    def q(context, observation, action):
        seen.append(context)
        return jnp.zeros((2, len(context)))

    def sample(key, number):
        return batch_of(jnp.zeros((number, OBSERVATIONS)))

    method.consolidate(KEY, params, state, 2, Tools(sample, q))
    assert_dirichlet(seen[0][:4000], [1, 1, 1])
    assert_dirichlet(seen[0][4000:], [1, 1])


def test_candidates_are_the_proposals_folded():
    rng = np.random.default_rng(8)
    for frozen in (0, 1, 3):
        method, params, state, anchors = in_training(rng, frozen)
        policies, valid = method.candidates(params, state, frozen)
        np.testing.assert_array_equal(valid, [frozen > 0] * SEARCH["rollouts"])
        for index, row in enumerate(state.proposals):
            policy = jax.tree.map(lambda x, i=index: x[i], policies)
            assert_near(policy, folded(anchors, row))
    assert method.in_budget
    assert not method.baseline


# Keeping an anchor


NAN = float("nan")


@pytest.mark.parametrize(
    ("after", "kept", "chosen"),
    [
        # The former subspace's best is 2: at improvement 0.5 more than 3 is needed.
        ((3.01, 1.0, 1.0, 2.0), True, 0),
        ((1.0, 3.01, 2.0, 1.0), True, 1),
        ((3.0, 1.0, 1.0, 2.0), False, 3),
        ((1.0, 2.99, 2.0, 1.0), False, 2),
        ((NAN, 2.0, 2.0, 1.0), False, 2),
        ((NAN, NAN, 1.0, 2.0), False, 3),
        ((NAN, 3.01, 2.0, NAN), True, 1),
        ((1.0, 2.0, NAN, NAN), True, 1),
    ],
)
def test_an_anchor_is_kept_if_it_helps(after, kept, chosen):
    method, params, before, anchors = in_training(
        np.random.default_rng(9), 2, improvement=0.5
    )
    following, state = method.end_task(params, before, 2, selection(*after))
    assert state.learned == 3
    assert state.frozen == 2 + kept
    assert method.size(following, state) == (2 + kept) * count(params)
    np.testing.assert_array_equal(state.best[2], before.proposals[chosen])
    used = anchors if kept else before.anchors
    for ours, theirs in zip(state.anchors, used, strict=True):
        assert_same(Linear(*(x[:3] for x in ours)), Linear(*(x[:3] for x in theirs)))
    even = (np.arange(TASKS) < 2 + kept) / (2 + kept)
    assert_near(following, folded(anchors, even))
    # A dropped anchor is nowhere, and the next one takes its slot.
    traces = np.concatenate([np.ravel(x) for x in jax.tree.leaves((following, state))])
    assert np.isin(params[1].weight, traces).all() == kept
    newer = jax.tree.map(lambda x: x + 1, params)
    _, later = method.end_task(newer, state, 3, selection(9.0, 0.0, 0.0, 0.0))
    assert later.frozen == 3 + kept
    assert_same(jax.tree.map(lambda x: x[2 + kept], later.anchors), newer)


@pytest.mark.parametrize("after", [None, (0.0, 0.0, 5.0, 5.0), (NAN,) * 4])
def test_the_first_anchor_is_always_kept(after):
    method = make()
    params, state = method.init(KEY)
    chosen = after if after is None else selection(*after)
    following, state = method.end_task(params, state, 0, chosen)
    assert (state.learned, state.frozen) == (1, 1)
    np.testing.assert_array_equal(state.best[0], [1, 0, 0, 0])
    assert_same(following, params)
    assert_same(method.policy(following, state, 0), params)


def test_without_selection_the_newest_anchor_is_the_policy():
    method, params, state, _ = in_training(np.random.default_rng(10), 2)
    following, state = method.end_task(params, state, 2, None)
    assert state.frozen == 3
    np.testing.assert_array_equal(state.best[2], [0, 0, 1, 0])
    assert_same(method.policy(following, state, 2), params)


# Policies of tasks


def test_policies_of_finished_tasks_never_change():
    rng = np.random.default_rng(11)
    method = make()
    params, state = method.init(KEY)
    for task in range(TASKS):
        assert_same(method.policy(params, state, task), params)
    policies, returns = [], [(9.0, 0.0, 1.0, 1.0), (0.0, 0.0, 5.0, 1.0)]
    for task in range(TASKS):
        params = jax.tree.map(
            lambda x: x + rng.normal(size=x.shape).astype(np.float32), params
        )
        frozen = int(state.frozen)
        proposals = random_weights(rng, 4, frozen + 1)
        proposals[2:] = random_weights(rng, 2, max(frozen, 1))
        state = state._replace(proposals=proposals)
        # The anchors of the second and the last task are kept, not the third's.
        params, state = method.end_task(
            params, state, task, selection(*returns[task == 2])
        )
        weights = state.best[task]
        policies.append(method.policy(params, state, task))
        assert_near(policies[-1], folded(state.anchors, weights))
        unused = np.arange(TASKS) >= int(state.frozen)
        assert_on_simplex(weights, int(state.frozen))
        planted = state._replace(
            anchors=jax.tree.map(
                lambda x, u=unused: np.where(
                    u.reshape(-1, *[1] * (x.ndim - 1)), np.float32(np.nan), x
                ),
                state.anchors,
            )
        )
        for one in (state, planted):
            for known, policy in enumerate(policies):
                assert_same(method.policy(params, one, known), policy)
            for unseen in range(task + 1, TASKS):
                assert_same(method.policy(params, one, unseen), policies[-1])
    assert state.frozen == 3


def test_a_diverged_anchor_leaves_older_policies_alone():
    method, params, state, _ = in_training(np.random.default_rng(12), 1)
    best = np.eye(TASKS, dtype=np.float32)
    state = state._replace(best=best)
    before = method.policy(params, state, 0)
    broken = jax.tree.map(lambda x: x * np.nan, params)
    following, state = method.end_task(broken, state, 1, None)
    assert_same(method.policy(following, state, 0), before)


# Members
