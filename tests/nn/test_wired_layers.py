import functools

import chex
import flax.errors
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from rewire_jax import Permute, RewiredDense, permute
from rewire_jax.nn.networks import Linear
from rewire_jax.nn.wired_layers import wired

KEY = jax.random.key(0)
INPUTS, N, TAU = 5, 12, 0.5


def given(seed=0):
    """Parameters of a `RewiredDense`, its neurons in no order."""
    rng = np.random.default_rng(seed)
    shapes = {"weight": (N, INPUTS), "bias": N, "scores": N}
    return {
        name: rng.normal(size=shape).astype(np.float32)
        for name, shape in shapes.items()
    }


def test_scores_are_evenly_spaced_at_first_and_move_nothing():
    x = jax.random.normal(KEY, (3, N))
    output, variables = Permute().init_with_output(KEY, x)
    np.testing.assert_array_equal(output, x)
    (scores,) = jax.tree.leaves(variables)
    np.testing.assert_allclose(scores, np.linspace(0, 1, N), rtol=1e-6)
    assert jax.tree.leaves(Permute().init(KEY, x[:, :1])) == [0.0]
    params = RewiredDense(N).init(KEY, x[:, :INPUTS])["params"]
    assert {k: v.shape for k, v in params.items()} == {
        "weight": (N, INPUTS),
        "bias": (N,),
        "scores": (N,),
    }
    np.testing.assert_array_equal(params["scores"], scores)
    assert np.abs(params["weight"]).max() <= INPUTS**-0.5
    assert np.unique(params["weight"]).size == N * INPUTS


@pytest.mark.parametrize("batch", [1, INPUTS - 1, INPUTS, 40])
def test_a_rewired_layer_is_a_dense_one_in_the_order_of_its_scores(batch):
    # Whether the output or the weights are permuted, as the size of the batch has it.
    params = given()
    x = np.random.default_rng(1).normal(size=(batch, INPUTS)).astype(np.float32)
    layer = RewiredDense(N, TAU)
    output = (x @ params["weight"].T + params["bias"])[:, np.argsort(params["scores"])]
    got = layer.apply({"params": params}, x)
    np.testing.assert_allclose(got, output, rtol=1e-5, atol=1e-5)

    class Two(nn.Module):
        @nn.compact
        def __call__(self, x):
            dense = nn.Dense(N, name="dense")(x)
            return Permute(TAU, name="order")(dense)

    dense = {"kernel": params["weight"].T, "bias": params["bias"]}
    theirs = {"dense": dense, "order": {"scores": params["scores"]}}

    def loss(module, params):
        return jnp.sum(jnp.sin(module.apply({"params": params}, x)))

    ours = jax.grad(functools.partial(loss, layer))(params)
    theirs = jax.grad(functools.partial(loss, Two()))(theirs)
    assert np.any(np.abs(ours["scores"]) > 1e-3)
    for a, b in [
        (ours["weight"].T, theirs["dense"]["kernel"]),
        (ours["bias"], theirs["dense"]["bias"]),
        (ours["scores"], theirs["order"]["scores"]),
    ]:
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


def test_it_computes_what_the_method_does():
    params = given()
    x = jax.random.normal(KEY, (30, INPUTS))

    def module(params, tau):
        return RewiredDense(N, tau).apply({"params": params}, x)

    def function(params, tau):
        layer = Linear(params["weight"], params["bias"])
        return wired(layer, params["scores"], tau, x)

    def both(network, tau):
        value, pull = jax.vjp(lambda params: network(params, tau), params)
        return value, pull(jnp.cos(value))

    # The temperature may be traced.
    got, expected = (
        jax.jit(functools.partial(both, f))(TAU) for f in (module, function)
    )
    chex.assert_trees_all_equal(got, expected)


def test_layers_are_parts_of_nnx_networks():
    layer = nnx.bridge.ToNNX(RewiredDense(N, TAU), rngs=nnx.Rngs(0))
    x = jnp.ones((2, INPUTS))
    layer.lazy_init(x)
    params = given()
    for name, value in params.items():
        getattr(layer, name)[...] = value
    expected = permute(x @ params["weight"].T + params["bias"], params["scores"], TAU)
    np.testing.assert_allclose(layer(x), expected, rtol=1e-5, atol=1e-5)


def test_what_does_not_fit_is_refused():
    with pytest.raises(flax.errors.ScopeParamShapeError):
        Permute().apply({"params": {"scores": jnp.ones(3)}}, jnp.ones((2, 4)))
    with pytest.raises(flax.errors.ScopeParamShapeError):
        RewiredDense(N).apply({"params": given()}, jnp.ones((2, INPUTS + 1)))
    for layer in (Permute(), RewiredDense(N)):
        with pytest.raises(AssertionError):
            layer.init(KEY, jnp.ones((2, INPUTS), int))
