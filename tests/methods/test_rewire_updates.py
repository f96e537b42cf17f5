import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.methods import rewire_losses
from rewire_jax.methods.rewire import rewire
from rewire_jax.methods.rewire_losses import gaussian_kl, squared_differences
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.methods.rewire_state import Context
from tests.rewired import (
    ACTIONS,
    DEPTH,
    KEY,
    OBSERVATION,
    QUIET,
    SLOTS,
    SPEC,
    K,
    N,
    after_tasks,
    assert_near,
    assert_same,
    head_at,
    make,
    orders_of,
    play,
    trained,
)

# The forward pass


def test_distribution_is_the_wired_network_of_the_mode():
    method, rng = make(), np.random.default_rng(1)
    params, state = after_tasks(method, 2, rng)
    params, state = method.start_task(KEY, params, state, 2)
    params = trained(rng, params)
    noise = rng.normal(size=(DEPTH, N)).astype(np.float32)
    for mode in range(K):
        for added in (QUIET, noise):
            got = method.distribution(
                params, state, Context(mode, 0, added, KEY), OBSERVATION
            )
            orders = orders_of(params.scores[mode] + added)
            assert_near(got, play(params.hidden, orders, head_at(params, 2)))


def test_distribution_takes_any_batch():
    method = make()
    params, state = method.init(KEY)
    context = Context(0, 0, QUIET, KEY)
    whole = method.distribution(params, state, context, OBSERVATION)
    one = method.distribution(params, state, context, OBSERVATION[0])
    assert_near(one, (whole[0][0], whole[1][0]))


@pytest.mark.parametrize("rate", ["step", "gradient"])
def test_only_the_mode_in_use_learns_in_all_layers(rate):
    # By the dense straight-through form, with the gradient times K if asked.
    params, state = make().init(KEY)
    params = jax.tree.map(jnp.asarray, trained(np.random.default_rng(2), params))

    def ours(scores, tau):
        options = RewireSettings(head_slots=SLOTS, mode_rate=rate, tau=tau)
        method = rewire(SPEC, dataclasses.replace(options, mode_slots=K))
        context = Context(1, 0, QUIET, KEY)
        mean, log_std = method.distribution(
            params._replace(scores=scores), state, context, OBSERVATION
        )
        return jnp.sum(jnp.sin(mean) + log_std**2)

    def dense(scores):
        x = OBSERVATION
        for (weight, bias), v in zip(params.hidden, scores[1], strict=True):
            difference = jnp.sort(v)[:, None] - v[None, :]
            soft = jax.nn.softmax(-jnp.abs(difference) / 0.5, axis=-1)
            hard = jnp.eye(N)[jnp.argsort(v)]
            x = (x @ weight.T + bias) @ (hard + soft - jax.lax.stop_gradient(soft)).T
            x = jnp.where(x > 0, x, 0.2 * x)
        output = x @ params.heads.weight[0].T + params.heads.bias[0]
        mean, log_std = output[:, :ACTIONS], output[:, ACTIONS:]
        return jnp.sum(jnp.sin(mean) + log_std**2)

    value, got = jax.jit(jax.value_and_grad(ours))(params.scores, 0.5)
    expected_value, expected = jax.jit(jax.value_and_grad(dense))(params.scores)
    if rate == "gradient":
        expected *= K
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(value, expected_value, rtol=1e-4)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-4 * size)
    used = np.max(np.abs(got), axis=-1) > 1e-3 * size
    np.testing.assert_array_equal(used, np.arange(K)[:, None] == [1] * DEPTH)


def test_gradient_scaling_leaves_close_scores_in_order():
    params, state = make().init(KEY)
    close = np.float32(0.3) + np.float32(2**-24) * np.arange(N, dtype=np.float32)
    scores = np.random.default_rng(3).permuted(np.tile(close, (K, DEPTH, 1)), axis=-1)
    params = params._replace(scores=scores)
    context = Context(2, 0, QUIET, KEY)
    assert_same(
        *(
            make(mode_rate=rate).distribution(params, state, context, OBSERVATION)
            for rate in ("step", "gradient")
        )
    )


@pytest.mark.parametrize(("rate", "factor"), [("step", K), ("gradient", 1)])
def test_updates_are_scaled_after_the_optimiser(rate, factor):
    params, state = make().init(KEY)
    updates = jax.tree.map(jnp.ones_like, params)
    got = make(mode_rate=rate).adjust_updates(updates, state)
    assert_same(got, updates._replace(scores=factor * updates.scores))
    got = make(mode_rate=rate, adapter_rate=0.5).adjust_updates(updates, state)
    expected = updates._replace(
        adapters=jax.tree.map(lambda u: 0.5 * u, updates.adapters),
        scores=factor * updates.scores,
    )
    assert_same(got, expected)


# Distillation


def test_kl_against_numerical_integration():
    grid = np.linspace(-30, 30, 200_001)

    def log_density(mean, log_std):
        return -0.5 * ((grid - mean) / np.exp(log_std)) ** 2 - log_std

    rng = np.random.default_rng(4)
    p, q = rng.normal(size=(2, 2, 3, ACTIONS)).astype(np.float32) * 0.5
    got = gaussian_kl(p, q)
    assert got.shape == (3,)
    for row in range(3):
        expected = 0.0
        for action in range(ACTIONS):
            first, second = (log_density(*g[:, row, action]) for g in (p, q))
            weight = np.exp(first) / np.sum(np.exp(first))
            expected += np.sum(weight * (first - second))
        np.testing.assert_allclose(got[row], expected, rtol=1e-4)
    assert not np.allclose(got, gaussian_kl(q, p), rtol=0.05)
    np.testing.assert_allclose(gaussian_kl(p, p), 0, atol=1e-6)


def test_squares_in_numbers():
    p = np.array([[25.0, -1.0]]), np.array([[0.5, 0.0]])
    q = np.array([[22.0, 1.0]]), np.array([[0.0, -1.0]])
    # The first mean counts as 20: 2² + 2² + 0.5² + 1².
    np.testing.assert_allclose(squared_differences(p, q), [9.25])


@jax.jit
def penalty_and_gradient(options, params, state, mode, noise):
    method = rewire(SPEC, options)

    def loss(params, other):
        context = Context(mode, other, noise, KEY)
        gaussian = method.distribution(params, state, context, OBSERVATION)
        return method.penalty(KEY, params, state, context, OBSERVATION, gaussian)

    both = jax.value_and_grad(loss, has_aux=True)
    return jax.vmap(both, (None, 0))(params, jnp.arange(K))


def penalties(options, params, state, mode, noise=QUIET):
    """Penalty, metrics and gradient with each mode as the other one."""
    options = RewireSettings(**{"modes": K, "head_slots": SLOTS} | options).checked()
    (value, metrics), gradient = penalty_and_gradient(
        options, params, state, mode, noise
    )
    return value, metrics, gradient


# Two programs that have all the forms between them.
FORMS = {
    "kl": {"distillation": "kl", "alignment": "norm"},
    "squares": {"distillation": "squares", "alignment": "expanded"},
}


@pytest.mark.parametrize("form", FORMS)
def test_distillation_draws_the_mode_to_the_others(form):
    options = {"alpha": 1e-3} | FORMS[form]
    params, state = make().init(KEY)
    params = trained(np.random.default_rng(5), params)
    mode, others = 1, (0, 2)
    value, metrics, gradient = penalties(options, params, state, mode)
    head = head_at(params, 0)
    policies = [play(params.hidden, orders_of(v), head) for v in params.scores]

    def divergence(p, q):
        if form == "squares":
            return np.sum((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2, axis=-1).mean()
        variance = np.exp(2 * q[1])
        terms = q[1] - p[1] - 0.5
        terms += (np.exp(2 * p[1]) + (p[0] - q[0]) ** 2) / (2 * variance)
        return np.sum(terms, axis=-1).mean()

    expected = np.array([divergence(policy, policies[mode]) for policy in policies])
    assert np.ptp(expected[list(others)]) > 0.01 * np.max(expected)
    error = 1e-4 * np.max(expected)
    np.testing.assert_allclose(metrics["distillation"], expected, atol=error)
    # A mean over states, on the scale of the published sum over 512 of them.
    np.testing.assert_allclose(value, 1e-3 * 512 * metrics["distillation"], rtol=1e-5)

    # The other mode is a fixed target.
    scores = np.asarray(gradient.scores)
    assert np.all(scores[:, others, :] == 0)
    # From itself a mode does not differ.
    assert np.all(np.max(np.abs(scores[list(others), mode]), axis=-1) > 0)
    target = policies[0]

    def dense(params):
        x = OBSERVATION
        for (weight, bias), z in zip(
            params.hidden, orders_of(params_scores[mode]), strict=True
        ):
            x = x @ weight[z].T + bias[z]
            x = jnp.where(x > 0, x, 0.2 * x)
        x = x @ params.heads.weight[0].T + params.heads.bias[0]
        mean, log_std = x[:, :ACTIONS], x[:, ACTIONS:]
        p_mean, p_log_std = target
        if form == "squares":
            terms = (mean - p_mean) ** 2 + (log_std - p_log_std) ** 2
        else:
            terms = jnp.exp(2 * p_log_std) + (p_mean - mean) ** 2
            terms = log_std + terms / (2 * jnp.exp(2 * log_std))
        return 0.512 * jnp.mean(jnp.sum(terms, axis=-1))

    params_scores = params.scores
    expected = jax.jit(jax.grad(dense))(params)
    for a, b in zip(
        jax.tree.leaves((gradient.hidden, gradient.heads)),
        jax.tree.leaves((expected.hidden, expected.heads)),
        strict=True,
    ):
        tolerance = 1e-4 * np.max(np.abs(b))
        np.testing.assert_allclose(a[0], b, rtol=0, atol=tolerance)


def test_nothing_to_distil():
    # Identical modes, and a single mode whose own noise makes it differ.
    params, state = make().init(KEY)
    value = penalties({"alpha": 1.0}, params, state, 0)[0]
    assert np.all(np.abs(value) < 1e-3)

    noise = np.random.default_rng(20).normal(size=QUIET.shape).astype(np.float32)
    value = penalties({"alpha": 1.0}, params, state, 0, noise)[0]
    assert np.all(value > 0.1)
    options = {"modes": 1, "mode_slots": K, "alpha": 1.0}
    value, metrics, gradient = penalties(options, params, state, 0, noise)
    np.testing.assert_array_equal(value, 0)
    np.testing.assert_array_equal(metrics["distillation"], 0)
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0)


# Alignment in the penalty


@pytest.mark.parametrize("form", FORMS)
def test_alignment_counts_from_the_second_task_on(form):
    options = {"alpha": 0.0, "beta": 2.0, "adapter_tau": 0.3} | FORMS[form]
    method, rng = make(), np.random.default_rng(6)
    params, state = method.init(KEY)
    changed = trained(rng, params)
    inspect = make(**options).inspect
    value, _, gradient = penalties(options, changed, state, 0)
    np.testing.assert_array_equal(value, 0)
    assert inspect(changed, state, OBSERVATION)["alignment"] == 0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0)

    params, state = after_tasks(method, 1, rng)
    params, state = method.start_task(KEY, params, state, 1)
    changed = trained(rng, params)

    def expected(hidden, adapters):
        return rewire_losses.alignment_loss(
            hidden, params.hidden, adapters, 0.3, expanded=form == "squares"
        )

    value, _, gradient = penalties(options, changed, state, 0)
    loss, wanted = jax.jit(jax.value_and_grad(expected, (0, 1)))(
        changed.hidden, changed.adapters
    )
    told = inspect(changed, state, OBSERVATION)["alignment"]
    np.testing.assert_allclose(told, loss, rtol=1e-5)
    np.testing.assert_allclose(value, 2 * loss, rtol=1e-5)
    for a, b in zip(
        jax.tree.leaves((gradient.hidden, gradient.adapters)),
        jax.tree.leaves(wanted),
        strict=True,
    ):
        np.testing.assert_allclose(a[0], 2 * b, rtol=1e-4, atol=1e-4)
    for leaf in jax.tree.leaves(gradient.heads):
        np.testing.assert_array_equal(leaf, 0)
