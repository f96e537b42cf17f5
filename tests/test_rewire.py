import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.errors import UserError
from rewire_jax.methods import find_method, finetune, wiring
from rewire_jax.methods import rewire as rewiring
from rewire_jax.methods.base import Selection, Spec
from rewire_jax.methods.rewire import Context, RewireSettings, gaussian_kl
from rewire_jax.networks import Linear

OBSERVATIONS, ACTIONS, N, DEPTH, TASKS, SLOTS, K = 5, 2, 12, 2, 6, 3, 3
SPEC = Spec(OBSERVATIONS, ACTIONS, N, DEPTH, TASKS)
FLAT = SPEC._replace(depth=1)
KEY = jax.random.key(0)
QUIET = np.zeros((DEPTH, N), np.float32)
OBSERVATION = np.random.default_rng(0).normal(size=(7, OBSERVATIONS))
OBSERVATION = OBSERVATION.astype(np.float32)


@functools.partial(jax.jit, static_argnums=(0, 1))
def call(name, spec, options, *arguments):
    return getattr(rewiring.rewire(spec, options), name)(*arguments)


def make(spec=SPEC, **values):
    """The method; as in a run, its numbers are traced, so that few are compiled."""
    options = RewireSettings(**{"modes": K, "head_slots": SLOTS} | values).checked()
    method = rewiring.rewire(spec, options)
    static = ("context", "act", "size", "adjust_updates")
    traced = {
        name: functools.partial(call, name, spec, options)
        for name in method._fields
        if name not in static
    }
    return method._replace(**traced)


def orders_of(scores):
    return np.argsort(np.asarray(scores), axis=-1, kind="stable")


def random_orders(rng, *shape):
    return rng.permuted(np.broadcast_to(np.arange(N), (*shape, N)), axis=-1)


def trained(rng, params, slot=None, hidden=True):
    """What training may do to the parameters: anything to all but other heads."""

    def shift(x, size=0.3):
        noise = rng.normal(size=x.shape, scale=size)
        return np.asarray(x + noise, np.asarray(x).dtype)

    heads = jax.tree.map(shift, params.heads)
    if slot is not None:
        heads = jax.tree.map(
            lambda old, new: np.where(
                np.arange(SLOTS).reshape(-1, *[1] * (old.ndim - 1)) == slot, new, old
            ),
            params.heads,
            heads,
        )
    return params._replace(
        hidden=jax.tree.map(shift, params.hidden) if hidden else params.hidden,
        heads=heads,
        scores=shift(params.scores),
        adapters=jax.tree.map(shift, params.adapters),
    )


def selection(after, before=0.0):
    after = np.asarray(after, np.float32)
    return Selection(np.broadcast_to(np.float32(before), after.shape), after)


def play(hidden, orders, head, observation=OBSERVATION):
    """Eq. 2 and 3 in numpy: mean, log-std."""
    x = observation.astype(np.float64)
    for (weight, bias), z in zip(hidden, orders, strict=True):
        x = (x @ np.asarray(weight.T, np.float64) + bias)[:, z]
        x = np.where(x > 0, x, 0.2 * x)
    output = x @ np.asarray(head.weight.T, np.float64) + head.bias
    return output[:, :ACTIONS], np.clip(output[:, ACTIONS:], -20, 2)


def head_at(params, slot):
    return Linear(*(leaf[slot] for leaf in params.heads))


def assert_near(actual, expected, rtol=2e-5):
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)


def assert_same(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


def after_tasks(method, number, rng, **kept):
    """Parameters and memory after some tasks of random learning."""
    params, memory = method.init(KEY)
    for task in range(number):
        params, memory = method.start_task(KEY, params, memory, task)
        params = trained(rng, params, task % SLOTS, **kept)
        places = params.scores.shape[0]
        rank = selection(rng.permutation(places) + 1.0)
        params, memory = method.end_task(params, memory, task, rank)
    return params, memory


def evenly_in(orders):
    scores = np.empty(orders.shape)
    even = np.broadcast_to(np.linspace(0, 1, orders.shape[-1]), orders.shape)
    np.put_along_axis(scores, orders, even, axis=-1)
    return scores


# The forward pass


def test_distribution_is_the_wired_network_of_the_mode():
    method, rng = make(), np.random.default_rng(1)
    params, memory = after_tasks(method, 2, rng)
    params, memory = method.start_task(KEY, params, memory, 2)
    params = trained(rng, params)
    noise = rng.normal(size=(DEPTH, N)).astype(np.float32)
    for mode in range(K):
        for added in (QUIET, noise):
            got = method.distribution(
                params, memory, Context(mode, 0, added, KEY), OBSERVATION
            )
            orders = orders_of(params.scores[mode] + added)
            assert_near(got, play(params.hidden, orders, head_at(params, 2)))


def test_distribution_takes_any_batch():
    method = make()
    params, memory = method.init(KEY)
    context = Context(0, 0, QUIET, KEY)
    whole = method.distribution(params, memory, context, OBSERVATION)
    one = method.distribution(params, memory, context, OBSERVATION[0])
    assert_near(one, (whole[0][0], whole[1][0]))


@pytest.mark.parametrize("rate", ["step", "gradient"])
def test_only_the_mode_in_use_learns_in_all_layers(rate):
    # By the dense straight-through form, with the gradient times K if asked.
    params, memory = make().init(KEY)
    params = jax.tree.map(jnp.asarray, trained(np.random.default_rng(2), params))

    def ours(scores, tau):
        options = RewireSettings(head_slots=SLOTS, mode_rate=rate, tau=tau)
        method = rewiring.rewire(SPEC, dataclasses.replace(options, mode_slots=K))
        context = Context(1, 0, QUIET, KEY)
        mean, log_std = method.distribution(
            params._replace(scores=scores), memory, context, OBSERVATION
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
    params, memory = make().init(KEY)
    close = np.float32(0.3) + np.float32(2**-24) * np.arange(N, dtype=np.float32)
    scores = np.random.default_rng(3).permuted(np.tile(close, (K, DEPTH, 1)), axis=-1)
    params = params._replace(scores=scores)
    context = Context(2, 0, QUIET, KEY)
    assert_same(
        *(
            make(mode_rate=rate).distribution(params, memory, context, OBSERVATION)
            for rate in ("step", "gradient")
        )
    )


@pytest.mark.parametrize(("rate", "factor"), [("step", K), ("gradient", 1)])
def test_updates_are_scaled_after_the_optimiser(rate, factor):
    params, memory = make().init(KEY)
    updates = jax.tree.map(jnp.ones_like, params)
    got = make(mode_rate=rate).adjust_updates(updates, memory)
    assert_same(got, updates._replace(scores=factor * updates.scores))
    got = make(mode_rate=rate, adapter_rate=0.5).adjust_updates(updates, memory)
    expected = updates._replace(
        adapters=jax.tree.map(lambda u: 0.5 * u, updates.adapters),
        scores=factor * updates.scores,
    )
    assert_same(got, expected)


# Contexts


@functools.partial(jax.jit, static_argnames=("number", "purpose"))
def contexts(options, number, purpose):
    method = rewiring.rewire(SPEC, options)
    _, memory = method.init(KEY)
    draw = jax.vmap(lambda key: method.context(key, memory, purpose, ()))
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
    params, memory = method.init(KEY)
    context = Context(0, 0, np.zeros((1, N), np.float32), jax.random.split(KEY, number))
    draw = jax.vmap(
        method.distribution, (None, None, Context(None, None, None, 0), None)
    )
    means = np.asarray(draw(params, memory, context, OBSERVATION)[0], np.float64)
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
    assert np.unique(method.distribution(params, memory, one, same)[0]).size > 50


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
    np.testing.assert_allclose(rewiring.squared_differences(p, q), [9.25])


@jax.jit
def penalty_and_gradient(options, params, memory, mode, noise):
    method = rewiring.rewire(SPEC, options)

    def loss(params, other):
        context = Context(mode, other, noise, KEY)
        gaussian = method.distribution(params, memory, context, OBSERVATION)
        return method.penalty(KEY, params, memory, context, OBSERVATION, gaussian)

    both = jax.value_and_grad(loss, has_aux=True)
    return jax.vmap(both, (None, 0))(params, jnp.arange(K))


def penalties(options, params, memory, mode, noise=QUIET):
    """Penalty, metrics and gradient with each mode as the other one."""
    options = RewireSettings(**{"modes": K, "head_slots": SLOTS} | options).checked()
    (value, metrics), gradient = penalty_and_gradient(
        options, params, memory, mode, noise
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
    params, memory = make().init(KEY)
    params = trained(np.random.default_rng(5), params)
    mode, others = 1, (0, 2)
    value, metrics, gradient = penalties(options, params, memory, mode)
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
    assert np.all(np.max(np.abs(scores[:, mode]), axis=-1) > 0)
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
    params, memory = make().init(KEY)
    value = penalties({"alpha": 1.0}, params, memory, 0)[0]
    assert np.all(np.abs(value) < 1e-3)

    noise = np.random.default_rng(20).normal(size=QUIET.shape).astype(np.float32)
    value = penalties({"alpha": 1.0}, params, memory, 0, noise)[0]
    assert np.all(value > 0.1)
    options = {"modes": 1, "mode_slots": K, "alpha": 1.0}
    value, metrics, gradient = penalties(options, params, memory, 0, noise)
    np.testing.assert_array_equal(value, 0)
    np.testing.assert_array_equal(metrics["distillation"], 0)
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0)


# Alignment in the penalty


@pytest.mark.parametrize("form", FORMS)
def test_alignment_counts_from_the_second_task_on(form):
    options = {"alpha": 0.0, "beta": 2.0, "adapter_tau": 0.3} | FORMS[form]
    method, rng = make(), np.random.default_rng(6)
    params, memory = method.init(KEY)
    changed = trained(rng, params)
    inspect = make(**options).inspect
    value, _, gradient = penalties(options, changed, memory, 0)
    np.testing.assert_array_equal(value, 0)
    assert inspect(changed, memory, OBSERVATION)["alignment"] == 0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0)

    params, memory = after_tasks(method, 1, rng)
    params, memory = method.start_task(KEY, params, memory, 1)
    changed = trained(rng, params)

    def expected(hidden, adapters):
        return wiring.alignment_loss(
            hidden, params.hidden, adapters, 0.3, expanded=form == "squares"
        )

    value, _, gradient = penalties(options, changed, memory, 0)
    loss, wanted = jax.jit(jax.value_and_grad(expected, (0, 1)))(
        changed.hidden, changed.adapters
    )
    told = inspect(changed, memory, OBSERVATION)["alignment"]
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


# The end of a task


def test_the_best_mode_is_cached_and_spread():
    method, rng = make(), np.random.default_rng(7)
    params, memory = method.init(KEY)
    params, memory = method.start_task(KEY, params, memory, 0)
    params = trained(rng, params)
    for best in range(K):
        after = np.full(K, -5.0)
        after[best] = -1.0
        done, kept = method.end_task(params, memory, 0, selection(after))
        orders = orders_of(params.scores[best])
        np.testing.assert_array_equal(kept.orders[0], orders)
        np.testing.assert_allclose(
            done.scores, np.tile(evenly_in(orders), (K, 1, 1)), rtol=1e-6
        )
        assert_same(done.hidden, params.hidden)
        assert_same(done.heads, params.heads)
        assert_same(kept.previous, params.hidden)
        assert kept.learned == 1
        assert kept.orders.dtype == memory.orders.dtype == jnp.int32
        # What is played is what was learned in the kept mode.
        played = method.act(method.policy(done, kept, 0), OBSERVATION)
        context = Context(best, 0, QUIET, KEY)
        wanted = method.distribution(params, memory, context, OBSERVATION)
        assert_near(played, wanted)
        candidates = method.candidates(params, memory, 0)
        assert np.all(candidates.valid)
        one = jax.tree.map(lambda leaf, k=best: leaf[k], candidates.policies)
        assert_near(method.act(one, OBSERVATION), wanted)


def test_without_selection_the_first_mode_is_kept():
    method, rng = make(), np.random.default_rng(8)
    params, memory = method.init(KEY)
    params = trained(rng, params)
    _, memory = method.end_task(params, memory, 0, None)
    np.testing.assert_array_equal(memory.orders[0], orders_of(params.scores[0]))


def test_the_first_task_is_never_undone():
    method, rng = make(), np.random.default_rng(9)
    params, memory = method.init(KEY)
    changed = trained(rng, params)
    worse = selection([-9.0, -8.0, -9.5], before=100.0)
    done, memory = method.end_task(changed, memory, 0, worse)
    assert_same(done.hidden, changed.hidden)
    assert_same(done.heads, changed.heads)
    np.testing.assert_array_equal(memory.orders[0], orders_of(changed.scores[1]))


@pytest.mark.parametrize("task", [1, 2, 3, 4])
def test_roll_back(task):
    # Task 1 has a fresh slot; tasks 3 and 4 come to theirs for the second time.
    method, rng = make(), np.random.default_rng([10, task])
    params, memory = after_tasks(method, task, rng)
    began, at_start = method.start_task(KEY, params, memory, task)
    changed = trained(rng, began, task % SLOTS)
    worse = selection([0.9, 0.8, -3.0], before=1.0)
    done, kept = method.end_task(changed, at_start, task, worse)
    assert_same(done, began)
    slot = task % SLOTS
    orders = np.array(memory.orders)
    orders[slot] = orders_of(began.scores[0])
    np.testing.assert_array_equal(kept.orders, orders)
    assert_same(kept.previous, memory.previous)
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
    params, memory = after_tasks(method, 1, rng)
    began, memory = method.start_task(KEY, params, memory, 1)
    changed = trained(rng, began)
    before = np.float32([1, 2, 3, 100, -100])
    for best, failed in ((2.1, False), (1.9, True)):
        after = np.float32([0.0, best, 1.0, 50.0, 60.0])
        done, _ = method.end_task(changed, memory, 1, Selection(before, after))
        assert_same(done.hidden, began.hidden if failed else changed.hidden)


def test_a_return_that_is_no_number_never_wins():
    method, rng = make(), np.random.default_rng(12)
    params, memory = after_tasks(method, 1, rng)
    began, memory = method.start_task(KEY, params, memory, 1)
    changed = trained(rng, began)
    result = selection([np.nan, 1.0, 2.0])
    _, kept = method.end_task(changed, memory, 1, result)
    np.testing.assert_array_equal(kept.orders[1], orders_of(changed.scores[2]))
    done, _ = method.end_task(changed, memory, 1, selection([np.nan] * 3))
    assert_same(done.hidden, began.hidden)


def test_refinement_comes_before_the_new_order():
    method, rng = make(), np.random.default_rng(13)
    params, memory = method.init(KEY)
    first = trained(rng, params)
    done, kept = method.end_task(first, memory, 0, selection([1, 2, 3]))
    # Before the first task nothing was cached, and adapters mean nothing.
    np.testing.assert_array_equal(kept.orders[1:], memory.orders[1:])

    began, memory = method.start_task(KEY, done, kept, 1)
    changed = trained(rng, began)
    done, kept = method.end_task(changed, memory, 1, selection([1, 3, 2]))
    refined = wiring.refine(memory.orders, changed.adapters)
    assert np.any(refined[0] != memory.orders[0])
    np.testing.assert_array_equal(kept.orders[0], refined[0])
    # The new order belongs to the new weights already.
    np.testing.assert_array_equal(kept.orders[1], orders_of(changed.scores[1]))
    assert_same(done.adapters, wiring.identity_adapters(DEPTH, N))

    # Adapters that learned nothing leave the cache alone.
    began, memory = method.start_task(KEY, done, kept, 2)
    _, kept = method.end_task(
        trained(rng, began)._replace(adapters=began.adapters), memory, 2, None
    )
    np.testing.assert_array_equal(kept.orders[:2], memory.orders[:2])


def test_policies_survive_a_permutation_of_the_weights():
    # W = P' W_prev P''^T through a whole task: all cached policies come back.
    method, rng = make(), np.random.default_rng(14)
    params, memory = after_tasks(method, 2, rng)
    before = [method.act(method.policy(params, memory, t), OBSERVATION) for t in (0, 1)]
    began, memory = method.start_task(KEY, params, memory, 2)
    changed = trained(rng, began, slot=2)
    out, inp = (orders_of(scores) for scores in changed.adapters)
    moved = []
    for index, (weight, bias) in enumerate(params.hidden):
        weight = np.asarray(weight)[out[index]]
        if index:
            weight = weight[:, inp[index - 1]]
        moved.append(Linear(weight, np.asarray(bias)[out[index]]))
    changed = changed._replace(hidden=tuple(moved))
    done, kept = method.end_task(changed, memory, 2, selection([1, 3, 2]))
    assert np.any(kept.orders[:2] != memory.orders[:2])
    for task, wanted in enumerate(before):
        played = method.act(method.policy(done, kept, task), OBSERVATION)
        assert_near(played, wanted)
    played = method.act(method.policy(done, kept, 2), OBSERVATION)
    head = head_at(changed, 2)
    assert_near(played, play(moved, orders_of(changed.scores[1]), head))


def test_policies_survive_a_task_that_leaves_the_weights():
    method, rng = make(), np.random.default_rng(15)
    params, memory = after_tasks(method, 2, rng)
    before = [method.act(method.policy(params, memory, t), OBSERVATION) for t in (0, 1)]
    assert not np.allclose(before[0][0], before[1][0], atol=0.01)
    began, memory = method.start_task(KEY, params, memory, 2)
    changed = trained(rng, began, slot=2, hidden=False)
    changed = changed._replace(adapters=began.adapters)
    done, kept = method.end_task(changed, memory, 2, selection([1, 3, 2]))
    for task, wanted in enumerate(before):
        played = method.act(method.policy(done, kept, task), OBSERVATION)
        assert_same(played, wanted)


# Slots


def test_a_task_starts_from_the_latest_or_its_own():
    method, rng = make(), np.random.default_rng(16)
    params, memory = method.init(KEY)
    for task in range(TASKS):
        source = task % SLOTS if task >= SLOTS else max(task - 1, 0)
        began, at_start = method.start_task(KEY, params, memory, task)
        assert_same(began.hidden, params.hidden)
        assert_same(head_at(began, task % SLOTS), head_at(params, source))
        assert_same(at_start.head, head_at(params, source))
        assert_same(at_start._replace(head=0), memory._replace(head=0))
        expected = evenly_in(np.asarray(memory.orders[source]))
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
        params, memory = method.end_task(
            params, at_start, task, selection(rng.permutation(K) + 1.0)
        )
        for other in range(SLOTS):
            if other != task % SLOTS:
                assert_same(head_at(params, other), head_at(began, other))


@pytest.mark.parametrize("learned", range(TASKS + 1))
def test_which_policy_a_task_gets(learned):
    method, rng = make(), np.random.default_rng([17, learned])
    params, memory = after_tasks(method, learned, rng)
    for task in range(TASKS):
        slot = task % SLOTS
        if slot >= learned:  # not seen, not even in an earlier round
            slot = max(learned - 1, 0)
        wanted = play(params.hidden, memory.orders[slot], head_at(params, slot))
        got = method.act(method.policy(params, memory, task), OBSERVATION)
        assert_near(got, wanted)


def test_there_are_no_more_slots_than_tasks():
    spec = SPEC._replace(tasks=2)
    params, memory = make(spec, head_slots=4).init(KEY)
    assert params.heads.bias.shape == (2, 2 * ACTIONS)
    assert memory.orders.shape == (2, DEPTH, N)


# Populations


def live(params, memory, shift, result, modes):
    """A task with a gradient step, in as many places as `shift` has."""
    options = RewireSettings(
        mode_slots=len(shift), head_slots=SLOTS, alpha=0.1, dropout=0.2
    )
    method = rewiring.rewire(FLAT, dataclasses.replace(options, modes=modes))
    params, memory = method.start_task(KEY, params, memory, 1)
    params = params._replace(
        scores=params.scores + shift,
        hidden=jax.tree.map(lambda x: 1.1 * x, params.hidden),
    )
    context = method.context(KEY, memory, "policy", ())

    def loss(params):
        gaussian = method.distribution(params, memory, context, OBSERVATION)
        penalty, metrics = method.penalty(
            KEY, params, memory, context, OBSERVATION, gaussian
        )
        return jnp.sum(gaussian[0]) + penalty, (gaussian, metrics)

    losses, gradient = jax.value_and_grad(loss, has_aux=True)(params)
    updates = method.adjust_updates(gradient, memory)
    params = jax.tree.map(lambda p, u: p - 0.01 * u, params, updates)
    candidates = method.candidates(params, memory, 1)
    outcome = Selection(result - 1, result)
    params, memory = method.end_task(params, memory, 1, outcome)
    policy = method.policy(params, memory, 1)
    size = method.size(params, memory)
    drawn = context.mode, context.noise
    return losses, updates, drawn, candidates, params, memory, policy, size


@pytest.mark.slow  # for the time its programs take to compile
def test_spare_places_change_nothing():
    # K = 3 beside K = 2 in five places, against itself alone in three.
    rng = np.random.default_rng(19)
    shift = rng.normal(size=(5, 1, N)).astype(np.float32)
    # The spare places have the best returns: they must not be chosen.
    result = np.arange(5, dtype=np.float32)
    params, memory = make(FLAT).init(KEY)
    memory = memory._replace(learned=jnp.asarray(1))
    wide = params._replace(scores=np.concatenate([params.scores, shift[K:]]))
    over_modes = jax.jit(jax.vmap(live, (None, None, None, None, 0)))
    together = over_modes(wide, memory, shift, result, np.array([2, K]))
    alone = jax.jit(live)(params, memory, shift[:K], result[:K], K)

    def compare(a, b):
        a = np.asarray(a[1])
        if a.shape != b.shape:  # the axis of modes
            assert len(a) == 5
            a = a[:K]
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)

    jax.tree.map(compare, together, alone)
    _, updates, (mode, _), candidates, _, memory, _, _ = together
    for index, modes in enumerate((2, K)):
        np.testing.assert_array_equal(candidates.valid[index], np.arange(5) < modes)
        learned = np.any(np.asarray(updates.scores[index]) != 0, axis=(1, 2))
        np.testing.assert_array_equal(learned, np.arange(5) == mode[index])
    assert np.any(memory.orders[0, 1] != memory.orders[1, 1])


# What is told about modes


def divergence(hidden, scores, head, observation=OBSERVATION):
    """Mean KL over pairs of modes, states and actions, one pair after the other."""
    policies = [play(hidden, orders_of(v), head, observation) for v in scores]
    pairs = []
    for i, (mean, log_std) in enumerate(policies):
        for j, (other, other_log_std) in enumerate(policies):
            if i == j:
                continue
            variance = np.exp(2 * np.float64(log_std))
            other_variance = np.exp(2 * np.float64(other_log_std))
            kl = np.log(other_variance / variance) / 2 - 0.5
            kl += (variance + (mean - other) ** 2) / (2 * other_variance)
            pairs.append(kl.sum(axis=-1).mean())
    return np.mean(pairs)


@pytest.mark.parametrize("learned", [0, 2])
def test_mode_divergence_against_a_loop_over_pairs(learned):
    rng = np.random.default_rng(29)
    method = make(dropout=0.3)  # must not be seen in it
    params, memory = method.init(KEY)
    params = trained(rng, params)
    memory = memory._replace(learned=jnp.asarray(learned))
    told = method.inspect(params, memory, OBSERVATION)
    head = head_at(params, learned)
    expected = divergence(params.hidden, params.scores, head)
    assert expected > 0.1
    np.testing.assert_allclose(told["mode_divergence"], expected, rtol=1e-4)
    # Not that of the other task's head.
    other = divergence(params.hidden, params.scores, head_at(params, 1))
    assert not np.isclose(expected, other, rtol=0.01)


def test_modes_that_are_not_in_use_have_no_part_in_the_divergence():
    params, memory = make().init(KEY)
    params = trained(np.random.default_rng(31), params)
    told = {}
    for modes in (1, 2, 3):
        method = make(modes=modes, mode_slots=5)
        spare = np.full((2, *params.scores.shape[1:]), np.nan, np.float32)
        wide = params._replace(scores=np.concatenate([params.scores, spare]))
        told[modes] = method.inspect(wide, memory, OBSERVATION)["mode_divergence"]
        if modes > 1:
            expected = divergence(
                params.hidden, params.scores[:modes], head_at(params, 0)
            )
            np.testing.assert_allclose(told[modes], expected, rtol=1e-4)
    assert told[1] == 0
    assert not np.isclose(told[2], told[3], rtol=0.01)


def test_equal_modes_are_not_apart():
    method = make()
    params, memory = method.init(KEY)
    params = trained(np.random.default_rng(37), params)
    # The same order in other scores: the policy is the same.
    scores = np.stack([params.scores[0] * factor for factor in (1.0, 2.0, 0.5)])
    told = method.inspect(params._replace(scores=scores), memory, OBSERVATION)
    assert told["mode_divergence"] == 0


# Variants (Table 3)


def test_alignment_off_is_a_distance_of_weights_and_moves_no_wiring():
    method, rng = make(alignment="off", alpha=0.0, beta=2.0), np.random.default_rng(20)
    params, memory = after_tasks(method, 2, rng)
    began, memory = method.start_task(KEY, params, memory, 2)
    moved = trained(rng, began)._replace(adapters=began.adapters)

    def loss(params):
        context = Context(0, 0, QUIET, KEY)
        gaussian = method.distribution(params, memory, context, OBSERVATION)
        return method.penalty(KEY, params, memory, context, OBSERVATION, gaussian)[0]

    value, gradient = jax.value_and_grad(loss)(moved)
    gaps = jax.tree.map(np.subtract, moved.hidden, memory.previous)
    squares = sum(np.sum(gap.astype(np.float64) ** 2) for gap in jax.tree.leaves(gaps))
    np.testing.assert_allclose(value, 2 * squares, rtol=1e-5)
    assert_near(
        jax.tree.leaves(gradient.hidden), [4 * gap for gap in jax.tree.leaves(gaps)]
    )
    for leaf in jax.tree.leaves((gradient.adapters, gradient.scores)):
        np.testing.assert_array_equal(leaf, 0)
    _, kept = method.end_task(moved, memory, 2, None)
    np.testing.assert_array_equal(kept.orders[:2], memory.orders[:2])
    stored = make().size(params, memory) - method.size(params, memory)
    assert stored == (2 * DEPTH - 1) * N


def test_without_caching_all_tasks_share_the_latest_wiring():
    method, rng = make(caching=False), np.random.default_rng(21)
    params, memory = after_tasks(method, 3, rng)
    assert memory.orders.shape == (1, DEPTH, N)
    assert np.any(memory.orders[0] != np.arange(N))
    for task in range(3):
        played = method.act(method.policy(params, memory, task), OBSERVATION)
        head = head_at(params, task)
        assert_near(played, play(params.hidden, memory.orders[0], head))
    began, _ = method.start_task(KEY, params, memory, 3)
    np.testing.assert_array_equal(orders_of(began.scores[0]), memory.orders[0])
    cached = make()
    spared = cached.size(*cached.init(KEY)) - method.size(*method.init(KEY))
    assert spared == (SLOTS - 1) * DEPTH * N


def test_the_policy_may_have_a_width_of_its_own():
    method = make(width=9)
    params, memory = method.init(KEY)
    assert params.scores.shape == (K, DEPTH, 9)
    same = make(SPEC._replace(hidden=9))
    assert method.size(params, memory) == same.size(params, memory)
    context = Context(0, 0, QUIET[:, :9], KEY)
    mean, _ = method.distribution(params, memory, context, OBSERVATION)
    assert mean.shape == (7, ACTIONS)


# Sizes

# Observations, actions, heads, FACTS.md's figure or None, numbers stored by hand:
# 2 * hidden + (heads + 1) * head + 3 * 3 * 256 + 5 * 256 + heads * 3 * 256.
SIZE_TABLE = [
    ("HalfCheetah, brax v1", 18, 6, 4, 2.11, 294_972),
    ("HalfCheetah, brax v1", 18, 6, 2, 2.06, 287_268),
    ("HalfCheetah", 17, 6, 4, None, 294_460),
    ("HalfCheetah", 17, 6, 2, None, 286_756),
    ("Ant", 27, 8, 4, 2.13, 304_720),
    ("Ant", 27, 8, 2, 2.07, 294_960),
    ("Humanoid", 244, 17, 4, 2.155, 438_954),
]


@pytest.mark.parametrize("row", SIZE_TABLE, ids=lambda row: f"{row[0]}, {row[3]}")
def test_model_size(row):
    _, observations, actions, heads, published, stored = row
    hidden = observations * 256 + 256 + 2 * (256 * 256 + 256)
    head = 256 * 2 * actions + 2 * actions
    by_hand = 2 * hidden + (heads + 1) * head + 3 * 768 + 5 * 256 + heads * 768
    assert by_hand == stored
    spec = Spec(observations, actions, 256, 3, 8)
    baseline = finetune.ft1(spec, finetune.FinetuneSettings())
    params, memory = jax.eval_shape(baseline.init, KEY)
    assert baseline.size(params, memory) == hidden + head

    for places in (0, 5):  # spare places are not stored
        options = RewireSettings(head_slots=heads, mode_slots=places).checked()
        method = rewiring.rewire(spec, options)
        params, memory = jax.eval_shape(method.init, KEY)
        assert method.size(params, memory) == stored
    if published:
        assert stored / (hidden + head) == pytest.approx(published, rel=0.01)


def test_base_sizes_as_published():
    for observations, actions, base in ((18, 6, 139_532), (27, 8, 142_864)):
        spec = Spec(observations, actions, 256, 3, 8)
        method = finetune.ft1(spec, finetune.FinetuneSettings())
        assert method.size(*jax.eval_shape(method.init, KEY)) == base


# Settings


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"modes": 0}, "--modes"),
        ({"modes": 4, "mode_slots": 3}, "--mode-slots"),
        ({"head_slots": 0}, "--head-slots"),
        ({"beta": -1.0}, "--beta"),
        ({"alpha": float("nan")}, "--alpha"),
        ({"noise": float("inf")}, "--noise"),
        ({"dropout": 1.0}, "--dropout"),
        ({"tau": 0.0}, "--tau"),
        ({"adapter_tau": -0.1}, "--adapter-tau"),
        ({"adapter_rate": -1.0}, "--adapter-rate"),
        ({"width": -1}, "--width"),
    ],
)
def test_senseless_settings_are_told(values, message):
    with pytest.raises(UserError, match=message):
        RewireSettings(**values).checked()


def test_presets():
    entry = find_method("rewire")
    cheetah = entry.preset("halfcheetah/forgetting", 4, "paper")
    assert (cheetah.tau, cheetah.noise, cheetah.dropout) == (1.0, 0.1, 0.0)
    assert (cheetah.alpha, cheetah.beta, cheetah.head_slots) == (1e-5, 100.0, 4)
    ant = entry.preset("ant/robustness", 2, "paper")
    assert (ant.tau, ant.noise, ant.dropout) == (0.1, 0.0, 0.1)
    assert (ant.alpha, ant.beta, ant.head_slots) == (1e-5, 0.1, 2)
    assert entry.preset("my/own", 7, "paper").head_slots == 7
    assert cheetah.modes == 3
    assert cheetah.checked().mode_slots == 3
