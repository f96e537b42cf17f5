import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.core.transition import Batch
from rewire_jax.methods import regularization
from rewire_jax.methods.base import Tools
from rewire_jax.methods.regularization import EwcSettings, FtL2Settings, fisher_diagonal
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks

SPEC = Spec(observations=3, actions=2, hidden=5, depth=2, tasks=3)
NUMBERS = (3 * 5 + 5) + (5 * 5 + 5) + (5 * 4 + 4)
KEY = jax.random.key(0)
STATES = 6
C = 3.5
METHODS = {
    "ft_l2": regularization.ft_l2(SPEC, FtL2Settings(coefficient=C).checked()),
    "ewc": regularization.ewc(
        SPEC, EwcSettings(coefficient=C, fisher_states=STATES).checked()
    ),
}
both = pytest.mark.parametrize("name", METHODS)


def states(seed):
    """Observations; the second entry is 0 in half of them."""
    x = np.random.default_rng(seed).normal(size=(STATES, 3)).astype(np.float32)
    x[::2, 1] = 0.0
    return x


def buffer(observation):
    """Tools whose buffer holds these observations in this order."""

    def sample(key, count):
        assert count == len(observation)
        return Batch(jnp.asarray(observation), *[None] * 6)

    return Tools(sample, lambda *_: pytest.fail("no method here needs a critic"))


def changed(rng, params):
    return jax.tree.map(
        lambda x: x + rng.normal(size=x.shape).astype(np.float32), params
    )


def end(method, params, state, task, observation):
    if method.consolidate is not None:
        params, state = method.consolidate(
            KEY, params, state, task, buffer(observation)
        )
    return method.end_task(params, state, task, None)


def run(method, tasks, seed=0):
    """Parameters, state and each task's trained policy after some tasks."""
    rng, own = np.random.default_rng(seed), []
    params, state = method.init(KEY)
    for task in range(tasks):
        params, state = method.start_task(KEY, params, state, task)
        params = changed(rng, params)
        own.append(params)
        params, state = end(method, params, state, task, states(task))
    return params, state, own


def penalty(method, params, state):
    loss, metrics = method.penalty(KEY, params, state, (), states(9), None)
    assert metrics.keys() == {"distance"}
    return loss


def policy(log_std_bias=(0.0, 0.0)):
    """A policy with moderate deviations, and the output biases of its log-stds."""
    layers = list(networks.init_mlp(jax.random.key(4), SPEC.sizes()))
    bias = layers[-1].bias.at[SPEC.actions :].set(jnp.asarray(log_std_bias))
    layers[-1] = layers[-1]._replace(bias=bias)
    return tuple(layers)


def assert_near(actual, expected, rtol=1e-5, atol=0.0):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=rtol, atol=atol),
        actual,
        expected,
    )


def assert_same(actual, expected):
    assert_near(actual, expected, rtol=0)


# The Fisher information

# One log-std within its bounds and one above, or both within.
POLICIES = {"inside": policy(), "clipped": policy((-0.5, 3.0))}
policies = pytest.mark.parametrize("layers", POLICIES.values(), ids=POLICIES)


@functools.partial(jax.jit, static_argnums=2)
def output_gradients(layers, state, activation):
    """Each output of the network, unclipped, and its gradients: a plain loop."""

    def network(layers):
        return networks.mlp(layers, state, activation)

    outputs = range(2 * SPEC.actions)
    return network(layers), [
        jax.grad(lambda w, i=i: network(w)[i])(layers) for i in outputs
    ]


def brute_force(layers, observation, activation=networks.activate):
    """The closed form, state by state and output by output, in numpy."""
    total = jax.tree.map(lambda x: np.zeros(x.shape), layers)
    for state in observation:
        output, gradients = output_gradients(layers, state, activation)
        diagonal = jax.tree.map(lambda x: np.zeros(x.shape), layers)
        for i in range(SPEC.actions):
            log_std = float(output[SPEC.actions + i])
            moves = -20 < log_std < 2
            variance = np.exp(2 * np.clip(log_std, -20, 2))
            for gradient, weight in (
                (gradients[i], 1.0),
                (gradients[SPEC.actions + i], 2 * variance * moves),
            ):
                diagonal = jax.tree.map(
                    lambda f, g, c=weight / (variance + 1e-6): (
                        f + c * np.asarray(g, np.float64) ** 2
                    ),
                    diagonal,
                    gradient,
                )
        total = jax.tree.map(lambda a, f: a + np.maximum(f, 1e-5), total, diagonal)
    return jax.tree.map(lambda a: a / len(observation), total)


@policies
def test_fisher_is_the_closed_form_of_each_output(layers):
    observation = states(1)
    got = jax.jit(fisher_diagonal)(layers, observation)
    expected = brute_force(layers, observation)
    assert_near(got, expected)
    # The mean of clamped states, not the clamped mean: some of them are clamped.
    clamped = [brute_force(layers, [state])[0].weight == 1e-5 for state in observation]
    assert 0 < np.mean(clamped) < 1


@pytest.mark.parametrize("network", ["layer_norm", "residual"])
def test_fisher_of_normalized_layers(network):
    layers, observation = POLICIES["inside"], states(1)
    activation = networks.ACTIVATIONS[network]
    got = jax.jit(fisher_diagonal, static_argnums=2)(layers, observation, activation)
    expected = brute_force(layers, observation, activation)
    assert_near(got, expected, rtol=1e-4, atol=1e-6)


def test_fisher_where_the_deviation_is_least():
    layers = policy((-30.0, 0.0))
    observation = states(2)
    got = jax.jit(fisher_diagonal)(layers, observation)
    assert_near(got, brute_force(layers, observation))
    assert np.max(got[-1].bias) < 1.001e6


@policies
def test_fisher_is_the_mean_square_of_the_score(layers):
    """Five standard errors, each below a twentieth of the value."""
    state = jnp.asarray([0.7, -1.2, 0.4])
    mean, log_std = networks.mlp_policy(layers, state)

    def log_density(layers, raw):
        """Of the action tanh(raw)."""
        mean, log_std = networks.mlp_policy(layers, state)
        normal = jax.scipy.stats.norm.logpdf(raw, mean, jnp.exp(log_std))
        return jnp.sum(normal - jnp.log(1 - jnp.tanh(raw) ** 2))

    @jax.jit
    def squares(key):
        noise = jax.random.normal(key, (40_000, SPEC.actions))
        raw = jnp.clip(mean + jnp.exp(log_std) * noise, -1e6, 1e6)
        scores = jax.vmap(jax.grad(log_density), (None, 0))(layers, raw)
        square = jax.tree.map(jnp.square, scores)
        return (
            jax.tree.map(lambda x: jnp.mean(x, axis=0), square),
            jax.tree.map(lambda x: jnp.std(x, axis=0) / 200.0, square),
        )

    estimate, error = squares(jax.random.key(2))
    got = jax.jit(fisher_diagonal)(layers, state[None])
    for f, m, e in zip(*map(jax.tree.leaves, (got, estimate, error)), strict=True):
        assert np.all(np.abs(f - np.maximum(m, 1e-5)) <= 5 * e + 1e-5 * f)
        assert np.all(e <= 0.05 * f)


def test_ewc_adds_up_the_tasks():
    method = METHODS["ewc"]
    _, state, own = run(method, 2)
    first, second = (brute_force(own[task], states(task)) for task in range(2))
    assert_near(state.importance, jax.tree.map(np.add, first, second), rtol=2e-5)


def test_ewc_draws_its_states_with_its_key():
    method, drawn = METHODS["ewc"], []
    params, state = method.init(KEY)

    def sample(key, count):
        drawn.append((key, count))
        return buffer(states(0)).sample(key, count)

    tools = buffer(states(0))._replace(sample=sample)
    method.consolidate(jax.random.key(5), params, state, 0, tools)
    ((key, count),) = drawn
    assert key == jax.random.key(5)
    assert count == STATES


# The penalty


@both
def test_no_penalty_before_a_task_has_ended(name):
    method = METHODS[name]
    params, state = method.init(KEY)
    params, state = method.start_task(KEY, params, state, 0)
    params = changed(np.random.default_rng(3), params)
    loss, gradient = jax.value_and_grad(lambda p: penalty(method, p, state))(params)
    assert loss == 0
    assert_same(gradient, jax.tree.map(np.zeros_like, params))


@both
def test_penalty_is_the_weighted_square_of_the_distance(name):
    method, rng = METHODS[name], np.random.default_rng(4)
    params, state, own = run(method, 2)
    assert penalty(method, params, state) == 0
    ones = jax.tree.map(np.ones_like, params)
    weight = state.importance if name == "ewc" else ones
    moved = changed(rng, params)
    gap = jax.tree.map(lambda a, b: np.asarray(a, np.float64) - b, moved, own[-1])
    loss, gradient = jax.value_and_grad(lambda p: penalty(method, p, state))(moved)
    terms = jax.tree.map(lambda f, g: np.sum(f * g**2), weight, gap)
    np.testing.assert_allclose(loss, C * sum(jax.tree.leaves(terms)), rtol=1e-5)
    assert_near(gradient, jax.tree.map(lambda f, g: 2 * C * f * g, weight, gap))


@both
def test_one_policy_for_all_tasks(name):
    method = METHODS[name]
    params, state, own = run(method, 2)
    for task in range(SPEC.tasks):
        assert_same(method.policy(params, state, task), own[-1])
    started, _ = method.start_task(KEY, params, state, 2)
    assert_same(started, own[-1])


@pytest.mark.parametrize(("name", "copies"), [("ft_l2", 2), ("ewc", 3)])
def test_size_counts_what_the_penalty_needs(name, copies):
    for tasks in range(3):
        params, state, _ = run(METHODS[name], tasks)
        assert METHODS[name].size(params, state) == copies * NUMBERS


@both
def test_members_side_by_side_are_as_alone_and_traced_once(name):
    traces = []

    def task_of_member(coefficient, params, state, task, moves, observation):
        traces.append(task)
        if name == "ft_l2":
            method = regularization.ft_l2(SPEC, FtL2Settings(coefficient=coefficient))
        else:
            options = EwcSettings(coefficient=coefficient, fisher_states=STATES)
            method = regularization.ewc(SPEC, options)
        params, state = method.start_task(KEY, params, state, task)
        params = jax.tree.map(jnp.add, params, moves)
        loss, slope = jax.value_and_grad(lambda p: penalty(method, p, state))(params)
        return *end(method, params, state, task, observation), loss, slope

    method, rng = METHODS[name], np.random.default_rng(6)
    coefficients = jnp.asarray([0.5, 20.0])
    together = jax.jit(jax.vmap(task_of_member, (0, 0, 0, None, 0, 0)))
    state = jax.vmap(method.init)(jax.random.split(KEY))
    alone = method.init(jax.random.split(KEY)[1])
    losses = []
    for task in range(2):
        moves = changed(rng, jax.tree.map(jnp.zeros_like, state[0]))
        observation = jnp.stack([states(task), states(task + 5)])
        *state, loss, slope = together(
            coefficients, *state, jnp.asarray(task), moves, observation
        )
        *alone, loss_alone, slope_alone = jax.jit(task_of_member)(
            coefficients[1],
            *alone,
            jnp.asarray(task),
            jax.tree.map(lambda x: x[1], moves),
            observation[1],
        )
        second = jax.tree.map(lambda x: x[1], (state, loss, slope))
        assert_near(second, (alone, loss_alone, slope_alone), rtol=1e-4, atol=1e-6)
        losses.append(loss)
    assert len(traces) == 2  # once together, once alone
    assert np.all(losses[0] == 0)
    assert np.all(losses[1] > 0)


# Settings


@pytest.mark.parametrize(
    ("scenario", "ft_l2", "ewc"),
    [
        ("halfcheetah/forgetting", 1e4, 0.01),
        ("ant/transfer", 1.0, 1e4),
        ("humanoid/hard", 0.01, 0.01),
        ("continual_world/t3", 1e5, 1e4),
        ("my/own", 1.0, 1.0),
    ],
)
def test_published_coefficients(scenario, ft_l2, ewc):
    for profile, number in (("paper", 1024), ("quick", 256)):
        options = regularization.preset_ft_l2(scenario, 4, profile)
        assert options == FtL2Settings(coefficient=ft_l2)
        options = regularization.preset_ewc(scenario, 4, profile)
        assert options == EwcSettings(coefficient=ewc, fisher_states=number)


@pytest.mark.parametrize("make", [FtL2Settings, EwcSettings])
@pytest.mark.parametrize("value", [-1.0, float("inf"), float("nan")])
def test_bad_coefficient(make, value):
    with pytest.raises(UserError, match="--coefficient must be at least 0"):
        make(coefficient=value).checked()


def test_bad_number_of_states():
    with pytest.raises(UserError, match="--fisher-states must be at least 1"):
        EwcSettings(fisher_states=0).checked()
