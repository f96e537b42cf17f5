import functools
import itertools

import chex
import flax.errors
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rewire_jax.nn import networks

KEY = jax.random.key(0)


def density(action, mean, std):
    """Of tanh(N(mean, std)) at `action`, by the change of variables, in float64."""
    action = np.asarray(action, np.float64)
    return stats.norm.pdf(np.arctanh(action), mean, std) / (1 - action**2)


def test_layers_are_uniform_within_torchs_bound():
    sizes = [9, 200, 50]
    layers = jax.jit(lambda key: networks.init_mlp(key, sizes))(KEY)
    chex.assert_shape([layer.weight for layer in layers], [(200, 9), (50, 200)])
    chex.assert_shape([layer.bias for layer in layers], [(200,), (50,)])
    for layer, inputs in zip(layers, sizes, strict=False):
        for values in layer:
            scaled = np.ravel(values) * np.sqrt(inputs)
            assert np.abs(scaled).max() <= 1 + 1e-6
            assert stats.kstest(scaled, stats.uniform(-1, 2).cdf).pvalue > 1e-4
    assert not np.any(np.isin(layers[0].weight, layers[0].bias))


def test_mlp_is_affine_layers_with_leaky_relu_between():
    random = np.random.default_rng(0)
    sizes = [3, 7, 5, 2]
    layers = [
        networks.Linear(random.normal(size=pair[::-1]), random.normal(size=pair[1]))
        for pair in itertools.pairwise(sizes)
    ]
    inputs = random.normal(size=(4, 6, 3))
    x = inputs
    for number, (weight, bias) in enumerate(layers):
        x = x @ weight.T + bias
        if number < 2:
            x = np.where(x > 0, x, 0.2 * x)
    np.testing.assert_allclose(
        jax.jit(networks.mlp)(layers, inputs), x, rtol=1e-4, atol=1e-5
    )


def drawn(key, sizes):
    """The first parameters from the key, without any of the package's functions."""
    layers = []
    keys = jax.random.split(key, len(sizes) - 1)
    for key, (inputs, outputs) in zip(keys, itertools.pairwise(sizes), strict=True):
        bound = inputs**-0.5
        weight, bias = (
            jax.random.uniform(key, shape, minval=-bound, maxval=bound)
            for key, shape in zip(
                jax.random.split(key), [(outputs, inputs), (outputs,)], strict=True
            )
        )
        layers.append({"weight": weight, "bias": bias})
    return layers


def assert_same(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


@pytest.mark.parametrize("sizes", [[3, 8, 8, 2], [5, 4]])
def test_the_module_draws_and_stores_what_runs_always_have(sizes):
    expected = drawn(KEY, sizes)
    module = networks.MLP(sizes[1:])
    variables = module.init(KEY, jnp.zeros((6, sizes[0])))
    named = {f"layers_{i}": layer for i, layer in enumerate(expected)}
    assert_same(variables, {"params": named})
    stored = tuple(networks.Linear(**layer) for layer in expected)
    assert_same(networks.init_mlp(KEY, sizes), stored)
    assert_same(networks.as_layers(variables), stored)
    assert_same(networks.as_variables(stored), variables)

    both = jax.random.split(KEY)
    stacked = jax.jit(jax.vmap(lambda key: networks.init_mlp(key, sizes)))(both)
    for i, key in enumerate(both):
        one = tuple(networks.Linear(**layer) for layer in drawn(key, sizes))
        assert_same(jax.tree.map(lambda x, i=i: x[i], stacked), one)


def test_the_module_applies_what_the_stored_layers_do():
    sizes = [3, 8, 8, 2]
    layers = networks.init_mlp(KEY, sizes)
    x = jax.random.normal(jax.random.key(1), (20, 3))

    @jax.jit
    def plain(layers, x):
        for layer in layers[:-1]:
            x = networks.activate(networks.affine(layer, x))
        return networks.affine(layers[-1], x)

    module = jax.jit(networks.MLP(sizes[1:]).apply)(networks.as_variables(layers), x)
    np.testing.assert_array_equal(module, plain(layers, x))
    np.testing.assert_array_equal(jax.jit(networks.mlp)(layers, x), plain(layers, x))
    bent = networks.MLP(sizes[1:], activation=jnp.tanh)
    output = x.astype(np.float64)
    for number, (weight, bias) in enumerate(layers):
        output = (np.tanh(output) if number else output) @ np.asarray(weight.T) + bias
    got = bent.apply(networks.as_variables(layers), x)
    np.testing.assert_allclose(got, output, rtol=1e-4, atol=1e-5)


class Normalized(nn.Module):
    """Two hidden layers of Flax's own parts."""

    @nn.compact
    def __call__(self, x):
        for number, size in enumerate((8, 6)):
            x = nn.Dense(size, name=str(number))(x)
            x = nn.LayerNorm(epsilon=1e-6, use_scale=False, use_bias=False)(x)
            x = nn.leaky_relu(x, 0.2)
        return nn.Dense(2, name="2")(x)


def test_layer_norm_is_flaxs_before_each_activation():
    layers = networks.init_mlp(KEY, [3, 8, 6, 2])
    x = jax.random.normal(jax.random.key(1), (20, 3))
    params = {
        str(number): {"kernel": layer.weight.T, "bias": layer.bias}
        for number, layer in enumerate(layers)
    }
    expected = jax.jit(Normalized().apply)({"params": params}, x)
    got = networks.mlp(layers, x, networks.ACTIVATIONS["layer_norm"])
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)
    assert not np.allclose(got, networks.mlp(layers, x), atol=1e-2)


def test_nearly_equal_neurons_are_normalized():
    # The mean of squares minus the square of the mean is negative in some rows.
    x = 3e3 + jax.random.normal(KEY, (100, 7)) * 1e-3
    fast = jnp.mean(x**2, axis=-1) - jnp.mean(x, axis=-1) ** 2
    assert jnp.min(fast) < -1e-6
    value, slope = jax.value_and_grad(
        lambda x: jnp.sum(networks.normalize_and_activate(x) ** 2)
    )(x)
    assert np.isfinite(value)
    assert np.isfinite(slope).all()


def test_residual_adds_each_hidden_layer_to_the_next():
    layers = networks.init_mlp(KEY, [3, 8, 8, 8, 2])
    x = np.random.default_rng(0).normal(size=(20, 3))

    def normalized(layer, x):
        x = x @ np.asarray(layer.weight, np.float64).T + layer.bias
        x = x - x.mean(axis=1, keepdims=True)
        x = x / np.sqrt((x**2).mean(axis=1, keepdims=True) + 1e-6)
        return np.where(x > 0, x, 0.2 * x)

    first = normalized(layers[0], x)
    second = first + normalized(layers[1], first)
    third = second + normalized(layers[2], second)
    expected = third @ layers[3].weight.T + layers[3].bias
    got = networks.mlp(layers, jnp.asarray(x), networks.ACTIVATIONS["residual"])
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("network", ["mlp", "layer_norm"])
def test_the_order_of_hidden_neurons_does_not_matter(network):
    layers = list(networks.init_mlp(KEY, [3, 8, 8, 2]))
    x = jax.random.normal(jax.random.key(1), (20, 3))
    play = networks.policy_of(network)
    expected = play(layers, x)
    random = np.random.default_rng(0)
    for index in range(2):
        order = random.permutation(8)
        here, following = layers[index : index + 2]
        layers[index] = networks.Linear(here.weight[order], here.bias[order])
        layers[index + 1] = following._replace(weight=following.weight[:, order])
    np.testing.assert_allclose(play(layers, x), expected, rtol=0, atol=1e-6)
    layers[1] = layers[1]._replace(weight=layers[1].weight[:, ::-1])
    assert not np.allclose(play(layers, x), expected, atol=1e-3)


def test_the_module_is_a_part_of_others():
    class Two(nn.Module):
        @nn.compact
        def __call__(self, x):
            return networks.MLP([8, 2])(x), networks.MLP([8, 2])(x)

    variables = Two().init(KEY, jnp.ones(3))
    first, second = (
        networks.as_layers({"params": p}) for p in variables["params"].values()
    )
    chex.assert_trees_all_equal_shapes(first, second)
    assert not np.any(np.isin(first[0].weight, second[0].weight))


def test_wrong_inputs_are_refused():
    variables = networks.as_variables(networks.init_mlp(KEY, [3, 8, 2]))
    with pytest.raises(flax.errors.ScopeParamShapeError):
        networks.MLP([8, 2]).apply(variables, jnp.ones(4))
    with pytest.raises(AssertionError):
        networks.MLP([8, 2]).apply(variables, jnp.ones(3, int))


def test_derivatives_are_those_of_plain_products():
    # The layers have a derivative rule of their own, forwards and backwards.
    layers = networks.init_mlp(jax.random.key(0), [3, 8, 8, 2])
    x = jax.random.normal(jax.random.key(1), (5, 4, 3))

    def plain(layers, x):
        for weight, bias in layers[:-1]:
            x = networks.activate(x @ weight.T + bias)
        return x @ layers[-1].weight.T + layers[-1].bias

    def derivatives(network):
        def total(layers, x):
            return jnp.sum(network(layers, x) ** 2)

        directions = jax.tree.map(jnp.cos, (layers, x))
        return (
            jax.grad(total, (0, 1))(layers, x),
            jax.jvp(network, (layers, x), directions)[1],
            jax.hessian(total, 1)(layers, x[0, 0]),
        )

    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4),
        derivatives(networks.mlp),
        derivatives(plain),
    )


def test_the_policy_splits_and_clips_its_output():
    output = jnp.asarray([[1.0, -30.0, 5.0, -25.0], [0.5, 0.2, -1.0, 2.5]])
    mean, log_std = networks.gaussian(output)
    np.testing.assert_array_equal(mean, output[:, :2])
    np.testing.assert_allclose(log_std, [[2.0, -20.0], [-1.0, 2.0]])


@pytest.mark.parametrize(
    ("mean", "std"), [(0.0, 1.0), (0.4, 0.3), (-0.8, 0.1), (0.2, 2.0)]
)
def test_log_density_is_that_of_a_squashed_gaussian(mean, std):
    # By a grid: the reference is a density. It has steep sides near ±1.
    centres = np.tanh(np.linspace(mean - 9 * std, mean + 9 * std, 20_001))
    inside = centres[np.abs(centres) < 1 - 1e-12]
    mass = np.trapezoid(density(inside, mean, std), inside)
    assert mass == pytest.approx(1, abs=1e-4)

    arguments = jnp.full((20_000, 1), mean), jnp.full((20_000, 1), np.log(std))
    action, log_density = jax.jit(networks.sample_action)(
        jax.random.normal(KEY, arguments[0].shape), *arguments
    )
    action = np.asarray(action[:, 0], np.float64)
    # Where float32 still tells the action from ±1.
    safe = np.abs(action) < 0.99
    assert safe.mean() > 0.3
    expected = np.log(density(action[safe], mean, std))
    np.testing.assert_allclose(log_density[safe], expected, rtol=2e-3, atol=2e-3)
    # The samples have the density: raw values are normal.
    raw = np.arctanh(action[safe])
    edges = (np.arctanh(np.array([-0.99, 0.99])) - mean) / std
    truncated = stats.truncnorm(*edges, loc=mean, scale=std)
    assert stats.kstest(raw, truncated.cdf).pvalue > 1e-4


def test_log_densities_add_up_over_actions():
    random = np.random.default_rng(0)
    mean = random.normal(size=(5, 4, 3)).astype(np.float32)
    log_std = random.uniform(-1.5, -0.5, size=(5, 4, 3)).astype(np.float32)
    action, log_density = jax.jit(networks.sample_action)(
        random.normal(size=mean.shape).astype(np.float32), mean, log_std
    )
    chex.assert_shape([action, log_density], [(5, 4, 3), (5, 4)])
    each = np.log(density(action, mean, np.exp(log_std)))
    np.testing.assert_allclose(log_density, each.sum(-1), rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("mean", [-60.0, 60.0])
def test_a_saturated_action_keeps_finite_density_and_gradients(mean):
    @functools.partial(jax.value_and_grad, argnums=(0, 1))
    def log_density(mean, log_std):
        return networks.sample_action(jnp.full((1,), 0.1), mean, log_std)[1]

    arguments = jnp.full((1,), mean), jnp.full((1,), networks.LOG_STD_MIN)
    value, gradients = jax.jit(log_density)(*arguments)
    # 1 / (1 - tanh²) grows as exp(2|mean|) / 4.
    assert value == pytest.approx(20 + 2 * 60 - np.log(4) - 0.9189, abs=3)
    assert gradients[0] == pytest.approx(2 * np.sign(mean), rel=1e-4)
    assert np.isfinite(gradients[1]).all()
