import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.methods import finetune
from rewire_jax.methods.spec import Spec

SPEC = Spec(observations=3, actions=2, hidden=5, depth=2, tasks=3)
NUMBERS = (3 * 5 + 5) + (5 * 5 + 5) + (5 * 4 + 4)
KEY = jax.random.key(0)
OBSERVATION = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
MAKE = {"ft1": finetune.ft1, "ft_n": finetune.ft_n, "sac_n": finetune.sac_n}


def make(name):
    return MAKE[name](SPEC, finetune.preset("probe/reach", 3, "paper").checked())


def key(task, member=0):
    return jax.random.fold_in(jax.random.key(member), task)


def changed(rng, params):
    return jax.tree.map(
        lambda x: x + rng.normal(size=x.shape).astype(np.float32), params
    )


def run(method, tasks, seed=0):
    """Parameters, state and each task's trained policy after some tasks."""
    rng, own = np.random.default_rng(seed), []
    params, state = method.init(KEY)
    for task in range(tasks):
        params, state = method.start_task(key(task), params, state, task)
        params = changed(rng, params)
        own.append(params)
        params, state = method.end_task(params, state, task, None)
    return params, state, own


def play(layers, observation):
    x = np.asarray(observation, np.float64)
    for n, (weight, bias) in enumerate(layers):
        x = x @ np.asarray(weight, np.float64).T + bias
        if n < len(layers) - 1:
            x = np.where(x > 0, x, 0.2 * x)
    return x[..., :2], np.clip(x[..., 2:], -20, 2)


def assert_same(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


def assert_all_differ(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert not np.any(np.asarray(x) == np.asarray(y))


@pytest.mark.parametrize("name", MAKE)
def test_training_forward_is_the_plain_policy(name):
    method = make(name)
    params, state, _ = run(method, 1)
    got = method.distribution(params, state, (), OBSERVATION)
    for a, b in zip(got, play(params, OBSERVATION), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5)
    assert_same(method.act(method.policy(params, state, 0), OBSERVATION), got)


@pytest.mark.parametrize("name", MAKE)
def test_policies_of_all_tasks_after_each(name):
    method = make(name)
    for learned in range(SPEC.tasks + 1):
        params, state, own = run(method, learned)
        for task in range(SPEC.tasks):
            kept = name != "ft1" and task < learned
            expected = own[task] if kept else params
            assert_same(method.policy(params, state, task), expected)


@pytest.mark.parametrize("name", ["ft_n", "sac_n"])
def test_kept_policies_act_the_same_whatever_comes_later(name):
    method, rng = make(name), np.random.default_rng(1)
    params, state, own = run(method, 2)
    assert_all_differ(*own)

    def actions():
        policies = [method.policy(params, state, task) for task in range(2)]
        return [method.act(policy, OBSERVATION) for policy in policies]

    before = actions()
    params, state = method.start_task(key(2), params, state, 2)
    params = changed(rng, params)
    assert_same(actions(), before)
    params, state = method.end_task(params, state, 2, None)
    assert_same(actions(), before)


@pytest.mark.parametrize("name", ["ft1", "ft_n"])
def test_finetuning_starts_from_the_previous_policy(name):
    method = make(name)
    params, state, own = run(method, 2)
    started, _ = method.start_task(key(2), params, state, 2)
    assert_same(started, own[1])


def test_sac_n_starts_from_fresh_weights():
    method = make("sac_n")
    params, state, _ = run(method, 2)

    def start(task, member):
        return method.start_task(key(task, member), params, state, task)[0]

    assert_same(start(2, 0), start(2, 0))
    for other in (start(1, 0), start(2, 1), params, method.init(KEY)[0]):
        assert_all_differ(start(2, 0), other)
    for layer, inputs in zip(start(2, 0), (3, 5, 5), strict=True):
        for leaf in layer:
            assert np.max(np.abs(leaf)) <= inputs**-0.5


@pytest.mark.parametrize(
    ("name", "policies"),
    [("ft1", (1, 1, 1, 1)), ("ft_n", (1, 1, 2, 3)), ("sac_n", (1, 1, 2, 3))],
)
def test_size_counts_the_policies_in_use(name, policies):
    method = make(name)
    sizes = [method.size(*run(method, tasks)[:2]) for tasks in range(SPEC.tasks + 1)]
    assert sizes == [n * NUMBERS for n in policies]


@pytest.mark.parametrize("name", MAKE)
def test_members_side_by_side_are_as_alone_and_traced_once(name):
    method, traces = make(name), []

    def task_of_member(key, params, state, task):
        traces.append(task)
        params, state = method.start_task(key, params, state, task)
        params = jax.tree.map(lambda x: x + jax.random.normal(key, x.shape), params)
        params, state = method.end_task(params, state, task, None)
        policies = [method.policy(params, state, t) for t in range(SPEC.tasks)]
        return params, state, policies, method.size(params, state)

    by_itself = jax.jit(task_of_member)
    together = jax.jit(jax.vmap(task_of_member, (0, 0, 0, None)))
    keys = [jax.vmap(jax.random.key)(jnp.arange(2) + 7 * task) for task in range(3)]
    state = jax.vmap(method.init)(keys[0])
    alone = method.init(keys[0][1])
    for task in range(SPEC.tasks):
        *state, policies, size = together(keys[task], *state, task)
        *alone, alone_policies, alone_size = by_itself(keys[task][1], *alone, task)
    assert len(traces) == 2  # once together, once alone

    first, second = (
        jax.tree.map(lambda x, m=m: x[m], (state, policies, size)) for m in range(2)
    )
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6),
        second,
        (alone, alone_policies, alone_size),
    )
    assert_all_differ(first[1], second[1])
