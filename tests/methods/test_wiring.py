import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.methods import rewire_losses, wiring
from rewire_jax.nn import networks
from rewire_jax.nn.networks import Linear
from rewire_jax.nn.wired_layers import wired

OBSERVATIONS, N, OUTPUTS, BATCH = 5, 16, 4, 9


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def make_layers(rng, sizes):
    return tuple(
        Linear(rng.normal(size=(b, a)) / np.sqrt(a), rng.normal(size=b))
        for a, b in itertools.pairwise(sizes)
    )


def make_hidden(rng, depth):
    return make_layers(rng, [OBSERVATIONS, *[N] * depth])


def matrix(order):
    """The paper's P = I[z, :]."""
    return np.eye(len(order))[order]


def make_orders(rng, *shape):
    return rng.permuted(np.broadcast_to(np.arange(N), (*shape, N)), axis=-1)


def sorting_into(rng, orders):
    """Unevenly spaced scores whose argsort is `orders`."""
    scores = np.empty(orders.shape)
    values = np.sort(rng.normal(size=orders.shape), axis=-1)
    np.put_along_axis(scores, orders, values, axis=-1)
    return scores


def straight_through(scores, tau):
    hard = jnp.eye(scores.shape[0])[jnp.argsort(scores)]
    difference = jnp.sort(scores)[:, None] - scores[None, :]
    soft = jax.nn.softmax(-jnp.abs(difference) / tau, axis=-1)
    return hard + soft - jax.lax.stop_gradient(soft)


def leaky(x):
    return np.where(x > 0, x, 0.2 * x)


def assert_trees_close(actual, expected, rtol=1e-10):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype == np.float64
        size = np.max(np.abs(b), initial=0.0)
        np.testing.assert_allclose(a, b, rtol=0, atol=rtol * size)


def test_spread_sorts_into_its_order_evenly():
    orders = make_orders(np.random.default_rng(0), 2, 3)
    scores = np.asarray(wiring.scores_of(jnp.asarray(orders)))
    np.testing.assert_array_equal(np.argsort(scores, axis=-1), orders)
    even = np.broadcast_to(np.linspace(0, 1, N), scores.shape)
    np.testing.assert_allclose(np.sort(scores, axis=-1), even, rtol=1e-6)
    np.testing.assert_array_equal(wiring.scores_of(jnp.zeros((2, 1), jnp.int32)), 0)


@pytest.mark.parametrize("batch", [BATCH, 2 * N])
def test_wired_network_equals_permuted_activations(double, batch):
    # Eq. 2 with dense matrices on the activations. The smaller batch has its
    # activations permuted in all layers but the first, the larger one in none.
    rng = np.random.default_rng(1)
    hidden, head = make_hidden(rng, 3), make_layers(rng, [N, OUTPUTS])[0]
    scores = sorting_into(rng, make_orders(rng, 3))
    observation = rng.normal(size=(batch, OBSERVATIONS))
    weight = rng.normal(size=(batch, OUTPUTS))

    def network(hidden, head, scores, tau):
        x = observation
        for layer, v in zip(hidden, scores, strict=True):
            x = networks.activate(wired(layer, v, tau, x))
        return networks.affine(head, x)

    def dense(hidden, head, scores, tau):
        x = observation
        for layer, v in zip(hidden, scores, strict=True):
            x = (x @ layer.weight.T + layer.bias) @ straight_through(v, tau).T
            x = jnp.where(x > 0, x, 0.2 * x)
        return x @ head.weight.T + head.bias

    def both(function, tau):
        value, pull = jax.vjp(
            lambda *leaves: function(*leaves, tau), hidden, head, scores
        )
        return value, pull(weight)

    ours = jax.jit(functools.partial(both, network))
    theirs = jax.jit(functools.partial(both, dense))
    for tau in (1.0, 0.1, 0.01):
        got = ours(tau)
        assert_trees_close(got, theirs(tau))
        assert np.all(np.max(np.abs(got[1][2]), axis=-1) > 0)


@pytest.mark.parametrize("batch", [1, N])
def test_fold_has_the_value_of_wired(double, batch):
    rng = np.random.default_rng(2)
    hidden, orders = make_hidden(rng, 3), make_orders(rng, 3)
    scores = jnp.asarray(sorting_into(rng, orders))
    folded = wiring.fold(hidden, orders)
    for plain, v, layer, z in zip(hidden, scores, folded, orders, strict=True):
        np.testing.assert_array_equal(layer.weight, matrix(z) @ plain.weight)
        np.testing.assert_array_equal(layer.bias, matrix(z) @ plain.bias)
        x = rng.normal(size=(batch, plain.weight.shape[1]))
        value = wired(plain, v, 0.1, x)
        np.testing.assert_allclose(value, networks.affine(layer, x), rtol=1e-12)


def realigned(rng, depth):
    """Layers, the same with their neurons moved, and the adapters that tell how.

    W = P' W_prev P''^T by matrix products.
    """
    previous = make_hidden(rng, depth)
    out, inp = make_orders(rng, depth), make_orders(rng, depth - 1)
    hidden = []
    for index, (weight, bias) in enumerate(previous):
        weight = matrix(out[index]) @ weight
        if index:
            weight = weight @ matrix(inp[index - 1]).T
        hidden.append(Linear(weight, matrix(out[index]) @ bias))
    adapters = wiring.Adapters(sorting_into(rng, out), sorting_into(rng, inp))
    return previous, tuple(hidden), jax.tree.map(jnp.asarray, adapters)


def play(hidden, head, orders, observation, network):
    """A wired policy in numpy, Eq. 2 and 3."""
    x = observation
    for (weight, bias), z in zip(hidden, orders, strict=True):
        x = (x @ weight.T + bias)[:, z]
        if network == "layer_norm":
            x = (x.T - x.mean(axis=1)).T
            x = (x.T / np.sqrt((x**2).mean(axis=1) + 1e-6)).T
        x = leaky(x)
    return x @ head.weight.T + head.bias


@pytest.mark.parametrize(
    ("depth", "network"), [(1, "mlp"), (2, "layer_norm"), (3, "mlp"), (3, "layer_norm")]
)
def test_exact_recovery(depth, network, double):
    rng = np.random.default_rng([3, depth])
    previous, hidden, adapters = realigned(rng, depth)
    head = make_layers(rng, [N, OUTPUTS])[0]
    observation = rng.normal(size=(BATCH, OBSERVATIONS))
    orders = make_orders(rng, 6, depth)
    orders[0] = np.arange(N)
    refined = np.asarray(wiring.refine(jnp.asarray(orders), adapters))
    assert refined.dtype == orders.dtype
    for cached, now in zip(orders, refined, strict=True):
        before = play(previous, head, cached, observation, network)
        after = play(hidden, head, now, observation, network)
        np.testing.assert_allclose(after, before, rtol=1e-12, atol=1e-13)
        # The test can fail: it does without refinement.
        stale = play(hidden, head, cached, observation, network)
        assert np.max(np.abs(stale - before)) > 0.1

    # The same through the functions that policies are made of.
    folded = [*wiring.fold(hidden, refined[1]), head]
    got = networks.mlp(folded, observation, networks.ACTIVATIONS[network])
    expected = play(previous, head, orders[1], observation, network)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-13)

    for index, layer in enumerate(wiring.adapt(previous, adapters, 0.1)):
        np.testing.assert_array_equal(layer.weight, hidden[index].weight)
        np.testing.assert_array_equal(layer.bias, hidden[index].bias)
    assert rewire_losses.alignment_loss(hidden, previous, adapters, 0.1) == 0


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_refine_multiplies_by_the_adapters(depth):
    # P''_{l+1} P_l P'_l^T, in matrices.
    rng = np.random.default_rng([4, depth])
    _, _, adapters = realigned(rng, depth)
    orders = make_orders(rng, 2, 3, depth)
    refined = wiring.refine(jnp.asarray(orders), adapters)
    assert refined.shape == orders.shape
    out, inp = np.argsort(adapters.out, axis=-1), np.argsort(adapters.inp, axis=-1)
    for where in np.ndindex(2, 3, depth):
        expected = matrix(orders[where]) @ matrix(out[where[-1]]).T
        if where[-1] + 1 < depth:
            expected = matrix(inp[where[-1]]) @ expected
        np.testing.assert_array_equal(matrix(refined[where]), expected)


def test_identity_adapters_change_nothing():
    rng = np.random.default_rng(5)
    for depth in (1, 3):
        identity = wiring.identity_adapters(depth, N)
        assert identity.out.shape == (depth, N)
        assert identity.inp.shape == (depth - 1, N)
        orders = make_orders(rng, 2, depth).astype(np.int32)
        refined = wiring.refine(jnp.asarray(orders), identity)
        np.testing.assert_array_equal(refined, orders)
        assert refined.dtype == np.int32
        hidden = make_hidden(rng, depth)
        assert rewire_losses.alignment_loss(hidden, hidden, identity, 0.1) == 0


@pytest.mark.parametrize("form", ["norm", "expanded"])
def test_alignment_loss_equals_the_dense_form(form, double):
    depth, rng = 3, np.random.default_rng(6)
    previous, moved, adapters = realigned(rng, depth)
    tau = 0.1

    def dense(hidden, previous, adapters):
        loss = 0.0
        for index in range(depth):
            left = straight_through(adapters.out[index], tau)
            weight = left @ previous[index].weight
            if index:
                weight = weight @ straight_through(adapters.inp[index - 1], tau).T
            pairs = [(hidden[index].weight, weight)]
            pairs.append((hidden[index].bias, left @ previous[index].bias))
            for now, then in pairs:
                if form == "norm":
                    loss += jnp.sum((now - then) ** 2)
                else:
                    loss += -2 * jnp.vdot(then, now) + jnp.vdot(now, now)
        return loss

    ours = functools.partial(
        rewire_losses.alignment_loss, tau=tau, expanded=form == "expanded"
    )
    other = make_hidden(rng, depth)
    nearly = jax.tree.map(lambda x: x + 0.1 * rng.normal(size=x.shape), moved)
    got = jax.jit(jax.value_and_grad(ours, (0, 2)))
    expected = jax.jit(jax.value_and_grad(dense, (0, 2)))
    for hidden in (other, nearly):
        arguments = hidden, previous, adapters
        assert_trees_close(got(*arguments), expected(*arguments))
    # Every adapter has something to learn.
    for leaf in jax.tree.leaves(got(other, previous, adapters)[1][1]):
        assert np.all(np.max(np.abs(leaf), axis=-1) > 0)


def test_forms_of_alignment_differ_by_a_constant(double):
    # In value, where the adapters are permutations.
    rng = np.random.default_rng(7)
    previous, moved, _ = realigned(rng, 3)
    constant = sum(np.sum(np.square(x)) for x in jax.tree.leaves(previous))
    for hidden in (moved, make_hidden(rng, 3)):
        adapters = realigned(rng, 3)[2]
        norm, expanded = (
            rewire_losses.alignment_loss(hidden, previous, adapters, 0.1, expanded=e)
            for e in (False, True)
        )
        np.testing.assert_allclose(norm, expanded + constant, rtol=1e-12)


def test_descent_finds_a_permutation(double):
    # Eq. 11 with all weights held: moving the adapters alone lowers the loss.
    rng = np.random.default_rng(8)
    previous = make_hidden(rng, 2)
    swapped = np.arange(N)
    swapped[[3, 4]] = [4, 3]
    orders = np.tile(np.arange(N), (2, 1))
    hidden = list(wiring.fold(previous, np.stack([swapped, orders[1]])))
    hidden[1] = hidden[1]._replace(weight=hidden[1].weight[:, swapped])
    adapters = wiring.identity_adapters(2, N)
    loss = jax.jit(jax.value_and_grad(rewire_losses.alignment_loss, 2))
    first, _ = loss(hidden, previous, adapters, 0.1)
    for _ in range(200):
        value, gradient = loss(hidden, previous, adapters, 0.1)
        adapters = jax.tree.map(lambda a, g: a - 1e-3 * g, adapters, gradient)
        if value == 0:
            break
    assert first > 1
    assert value == 0
