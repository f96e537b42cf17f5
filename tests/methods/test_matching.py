"""Alignment by matching, against brute force and SciPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from rewire_jax.methods import matching, wiring
from rewire_jax.methods.rewire_losses import weight_loss
from rewire_jax.nn.networks import Linear
from tests.rewired import random_orders

SIZE, WIDTH, DEPTH = 4, 5, 3
match = jax.jit(matching.match)


def layers(rng, width=WIDTH, depth=DEPTH):
    sizes = [SIZE, *[width] * depth]
    return tuple(
        Linear(
            rng.normal(size=(after, before)).astype(np.float32),
            rng.normal(size=after).astype(np.float32),
        )
        for before, after in itertools.pairwise(sizes)
    )


def near(rng, previous, size):
    return jax.tree.map(
        lambda x: np.float32(x + size * rng.normal(size=x.shape)), previous
    )


def distance(now, then, row, column):
    weight, bias = np.asarray(then.weight)[row], np.asarray(then.bias)[row]
    if column is not None:
        weight = weight[:, column]
    return np.sum((now.weight - weight) ** 2) + np.sum((now.bias - bias) ** 2)


def orders(adapters):
    return [np.argsort(scores, axis=-1) for scores in adapters]


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6, 7])
def test_an_assignment_is_the_best_of_all(n):
    rng = np.random.default_rng(n)
    all_orders = np.array(list(itertools.permutations(range(n))))
    for _ in range(5):
        gain = rng.normal(size=(n, n)).astype(np.float32)
        totals = gain[np.arange(n), all_orders].sum(axis=1)
        found = np.asarray(matching.assign(gain))
        np.testing.assert_array_equal(np.sort(found), np.arange(n))
        np.testing.assert_array_equal(found, all_orders[np.argmax(totals)])


@pytest.mark.parametrize("size", [0.3, 3.0])
def test_an_assignment_of_256_is_scipys(size):
    rng = np.random.default_rng(0)
    gain = np.float32(np.eye(256) + size * rng.normal(size=(256, 256)))
    rows, columns = linear_sum_assignment(gain, maximize=True)
    found = np.asarray(matching.assign(gain))
    np.testing.assert_array_equal(found[rows], columns)


@pytest.mark.parametrize("size", [0.5, 1.5, 4.0])
def test_each_side_is_the_best_for_the_other(size):
    rng = np.random.default_rng(1)
    previous = layers(rng)
    hidden = near(rng, previous, size)
    start = wiring.identity_adapters(DEPTH, WIDTH)
    out, inp = orders(match(hidden, previous, start))
    every = [np.array(z) for z in itertools.permutations(range(WIDTH))]
    for index, (now, then) in enumerate(zip(hidden, previous, strict=True)):
        column = inp[index - 1] if index else None
        found = distance(now, then, out[index], column)
        least = min(distance(now, then, z, column) for z in every)
        np.testing.assert_allclose(found, least, rtol=1e-5)
        if index:
            least = min(distance(now, then, out[index], z) for z in every)
            np.testing.assert_allclose(found, least, rtol=1e-5)
        assert found <= distance(now, then, np.arange(WIDTH), None) * (1 + 1e-5)


def test_the_best_of_both_sides_is_found_for_small_changes():
    # 120² pairs of permutations a layer.
    rng = np.random.default_rng(2)
    previous = layers(rng, depth=2)
    hidden = near(rng, previous, 0.5)
    out, inp = orders(match(hidden, previous, wiring.identity_adapters(2, WIDTH)))
    every = [np.array(z) for z in itertools.permutations(range(WIDTH))]
    now, then = hidden[1], previous[1]
    least = min(distance(now, then, a, b) for a in every for b in every)
    np.testing.assert_allclose(distance(now, then, out[1], inp[0]), least, rtol=1e-5)


@pytest.mark.parametrize("side", ["out", "inp"])
def test_a_permutation_of_256_is_found(side):
    rng = np.random.default_rng(3)
    previous = layers(rng, 256, 2)
    z = np.random.default_rng(4).permutation(256)
    row, column = (z, slice(None)) if side == "out" else (slice(None), z)
    hidden = tuple(
        Linear(w[row][:, column] if index else w[row], b[row])
        for index, (w, b) in enumerate(previous)
    )
    found = match(hidden, previous, wiring.identity_adapters(2, 256))
    adapted = wiring.adapt(previous, found, 0.1)
    jax.tree.map(np.testing.assert_array_equal, tuple(adapted), hidden)


def test_where_it_begins_is_never_left_for_worse():
    rng = np.random.default_rng(5)
    previous = layers(rng)
    hidden = near(rng, previous, 3.0)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        begin = wiring.Adapters(
            *(
                wiring.scores_of(
                    rng.permuted(np.tile(np.arange(WIDTH), (k, 1)), axis=1)
                )
                for k in (DEPTH, DEPTH - 1)
            )
        )
        found = match(hidden, previous, begin)
        before, after = (
            weight_loss(hidden, wiring.adapt(previous, adapters, 0.1))
            for adapters in (begin, found)
        )
        assert after <= before * (1 + 1e-5)


def test_members_do_not_touch_each_other():
    rng = np.random.default_rng(6)
    previous = [layers(rng) for _ in range(3)]
    hidden = [near(rng, p, size) for p, size in zip(previous, (0.1, 1, 5), strict=True)]
    start = wiring.identity_adapters(DEPTH, WIDTH)
    crowd = jax.vmap(matching.match, (0, 0, None))(
        *(jax.tree.map(lambda *x: jnp.stack(x), *tree) for tree in (hidden, previous)),
        start,
    )
    for member in range(3):
        alone = match(hidden[member], previous[member], start)
        jax.tree.map(
            lambda a, b, m=member: np.testing.assert_array_equal(a[m], b), crowd, alone
        )


def test_one_layer_and_what_is_not_finite():
    rng = np.random.default_rng(7)
    previous = layers(rng, depth=1)
    order = random_orders(rng)[:WIDTH].argsort()
    hidden = (Linear(previous[0].weight[order], previous[0].bias[order]),)
    out, inp = match(hidden, previous, wiring.identity_adapters(1, WIDTH))
    np.testing.assert_array_equal(np.argsort(out[0]), order)
    assert inp.shape == (0, WIDTH)
    broken = (Linear(np.full_like(previous[0].weight, np.nan), previous[0].bias),)
    out, _ = match(broken, previous, wiring.identity_adapters(1, WIDTH))
    np.testing.assert_array_equal(np.sort(np.argsort(out[0])), np.arange(WIDTH))
