"""CKA-RL, against a plain version in NumPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from rewire_jax.core.errors import UserError
from rewire_jax.methods import cka
from rewire_jax.methods.cka import CkaSettings
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks

SPEC = Spec(observations=3, actions=2, hidden=5, depth=2, tasks=6)
NUMBERS = (3 * 5 + 5) + (5 * 5 + 5) + (5 * 4 + 4)
KEY = jax.random.key(0)
OBSERVATION = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)


def flat(layers):
    return np.asarray(ravel_pytree(layers)[0], np.float64)


def trained(rng, params):
    """What training may do: anything to the vector and the logits."""
    vector = jax.tree.map(
        lambda x: x + rng.normal(size=x.shape).astype(np.float32), params.vector
    )
    logits = rng.normal(size=8)[: len(params.logits)].astype(np.float32)
    return params._replace(vector=vector, logits=logits)


def run(pool, tasks):
    """Policies right after each task, and parameters and state at the end."""
    method, rng = (
        cka.cka(SPEC, CkaSettings(pool=pool).checked()),
        np.random.default_rng(1),
    )
    (params, state), own = method.init(KEY), []
    for task in range(tasks):
        params, state = method.start_task(KEY, params, state, task)
        params = trained(rng, params)
        played = method.distribution(params, state, (), OBSERVATION)
        params, state = method.end_task(params, state, task, None)
        policy = method.policy(params, state, task)
        own.append((flat(policy), played, method.act(policy, OBSERVATION)))
    return method, params, state, own


def brute_merge(vectors):
    """The vectors and, for each, the places that went into it."""
    pairs = itertools.combinations(range(len(vectors)), 2)

    def cosine(pair):
        a, b = (vectors[i] for i in pair)
        return a @ b / np.linalg.norm(a) / np.linalg.norm(b)

    first, second = max(pairs, key=cosine)
    merged = [(v, [i]) for i, v in enumerate(vectors)]
    merged[first] = (vectors[first] + vectors[second]) / 2, [first, second]
    merged[second] = merged[-1]
    return merged[:-1]


@pytest.mark.parametrize("n", [2, 3, 6])
def test_merging_is_that_of_all_pairs(n):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        vectors, weights = rng.normal(size=(n, 7)), rng.normal(size=(4, n))
        pool, kept = cka.merge(jnp.asarray(vectors), jnp.asarray(weights))
        expected = brute_merge(list(vectors))
        assert len(pool) == n - 1
        for place, (vector, places) in enumerate(expected):
            np.testing.assert_allclose(pool[place], vector, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(
                kept[:, place], weights[:, places].sum(axis=1), rtol=1e-5, atol=1e-6
            )


def test_a_policy_is_base_and_softmax_of_the_pool_and_its_own_vector():
    method, params, state, _ = run(5, 3)
    params, state = method.start_task(KEY, params, state, 3)
    assert np.all(flat(params.vector) == 0)
    params = trained(np.random.default_rng(2), params)
    logits = np.asarray(params.logits, np.float64)[:2]  # two vectors are known
    odds = np.exp(logits) / np.exp(logits).sum()
    pool = np.asarray(state.pool, np.float64)[:2]
    expected = state.base + odds @ pool + flat(params.vector)
    _, unravel = ravel_pytree(method.policy(params, state, 0))
    wanted = networks.mlp_policy(
        unravel(jnp.asarray(expected, jnp.float32)), OBSERVATION
    )
    got = method.distribution(params, state, (), OBSERVATION)
    for a, b in zip(got, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
    gradient = jax.grad(
        lambda params: jnp.sum(method.distribution(params, state, (), OBSERVATION)[0])
    )(params)
    assert np.all(gradient.logits[:2] != 0)
    np.testing.assert_array_equal(gradient.logits[2:], 0)


def test_earlier_policies_never_change_while_the_pool_has_room():
    method, params, state, own = run(5, 6)
    for task, (policy, played, acted) in enumerate(own):
        np.testing.assert_allclose(
            flat(method.policy(params, state, task)), policy, rtol=1e-5, atol=1e-5
        )
        # What is kept is what was trained.
        for a, b in zip(played, acted, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


def test_a_full_pool_changes_only_policies_with_merged_vectors():
    # Before the fourth task, the pool holds the vectors of the second and the third.
    _, _, before, _ = run(2, 3)
    method, params, state, own = run(2, 4)
    np.testing.assert_array_equal(state.base, before.base)
    base, kept = np.asarray(state.base), np.asarray(before.pool)
    # The fourth task's own vector, from what its policy is right after it.
    after = [flat(method.policy(params, state, task)) for task in range(4)]
    np.testing.assert_allclose(after[0], own[0][0], rtol=1e-5, atol=1e-5)
    vectors = [vector for vector, _ in brute_merge([*kept, fourth_vector()])]
    for place, vector in enumerate(vectors):
        np.testing.assert_allclose(state.pool[place], vector, rtol=1e-4, atol=1e-5)
    for task in range(4):
        expected = base + np.asarray(state.weights[task]) @ np.asarray(vectors)
        np.testing.assert_allclose(after[task], expected, rtol=1e-4, atol=1e-4)


def fourth_vector():
    """What the fourth task adds, in a run whose pool has room for it."""
    _, _, state, _ = run(5, 4)
    return np.asarray(state.pool[2])


def test_sizes():
    for pool in (2, 5):
        for tasks in range(7):
            method, params, state, _ = run(pool, tasks)
            vectors = min(max(tasks - 1, 0), pool)
            expected = NUMBERS * (1 + vectors) + tasks * vectors
            assert method.size(params, state) == expected


def test_a_pool_needs_a_place():
    with pytest.raises(UserError, match="--pool"):
        CkaSettings(pool=0).checked()
