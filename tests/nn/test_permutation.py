import functools
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from rewire_jax import permute

SIZES = (1, 2, 7, 256)
TAUS = (1.0, 0.1, 0.01)
KINDS = ("even", "shuffled", "ties", "equal", "negative", "wide", "huge")


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def make_scores(kind, n, rng):
    even = np.arange(n) / max(n - 1, 1)
    return {
        "even": even,
        "shuffled": rng.permutation(even),
        "ties": rng.integers(0, max(n // 2, 2), n) / 4,
        "equal": np.full(n, 0.3),
        "negative": -1 - 3 * rng.random(n),
        "wide": 5 * rng.normal(size=n),
        "huge": 1e8 * rng.normal(size=n),
    }[kind]


def relaxation(scores, tau):
    difference = jnp.sort(scores)[:, None] - scores[None, :]
    return jax.nn.softmax(-jnp.abs(difference) / tau, axis=-1)


def dense(x, scores, tau):
    """Eq. 3 forward and Eq. 4 backward, with n x n matrices."""
    hard = jnp.eye(scores.shape[0], dtype=x.dtype)[jnp.argsort(scores)]
    soft = relaxation(scores, tau).astype(x.dtype)
    return x @ (hard + soft - jax.lax.stop_gradient(soft)).T


def value_and_gradients(function, x, scores, tau, weight):
    value, pull = jax.vjp(lambda x, v: function(x, v, tau), x, scores)
    return value, *pull(weight)


ours = jax.jit(functools.partial(value_and_gradients, permute))
theirs = jax.jit(functools.partial(value_and_gradients, dense))


def assert_close(actual, expected, rtol=1e-10, floor=0.0):
    """Relative to the largest entry: single ones may be sums that cancel."""
    chex.assert_trees_all_equal_shapes_and_dtypes(actual, expected)
    size = max(np.max(np.abs(expected), initial=0.0), floor)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=rtol * size)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("kind", KINDS)
def test_equals_the_dense_straight_through_form(kind, n, double):
    rng = np.random.default_rng([n, KINDS.index(kind)])
    x, weight = rng.normal(size=(2, 5, n))
    scores = make_scores(kind, n, rng)
    for tau in TAUS:
        got = ours(x, scores, tau, weight)
        expected = theirs(x, scores, tau, weight)
        # The score gradient is a difference of terms as large as these.
        terms = np.max(np.abs(weight.T @ x)) / tau
        # Where the neighbours are many tau away, all that is left is rounding.
        floors = (0.0, 0.0, 1e-5 * terms)
        for a, b, floor in zip(got, expected, floors, strict=True):
            assert_close(a, b, floor=floor)
        np.testing.assert_array_equal(got[0], x[:, np.argsort(scores, kind="stable")])


def test_has_a_gradient_to_compare(double):
    # Guards the comparison above against gradients that all vanish.
    rng = np.random.default_rng(0)
    x, weight = rng.normal(size=(2, 5, 256))
    for kind in ("shuffled", "ties", "equal", "negative", "wide"):
        for tau in TAUS:
            gradient = ours(x, make_scores(kind, 256, rng), tau, weight)[2]
            terms = np.max(np.abs(weight.T @ x)) / tau
            assert np.max(np.abs(gradient)) > 1e-4 * terms


@pytest.mark.parametrize("tau", TAUS)
def test_score_gradient_is_the_slope_of_the_relaxation(tau, double):
    # By finite differences in numpy, with no automatic differentiation at all.
    n, step = 7, 1e-6 * tau
    rng = np.random.default_rng(1)
    x, weight = rng.normal(size=(2, 3, n))
    scores = rng.permutation(np.arange(n) / (n - 1)) + 0.02 * rng.random(n)

    def relaxed(scores):
        logits = -np.abs(np.sort(scores)[:, None] - scores[None, :]) / tau
        soft = np.exp(logits - logits.max(axis=1, keepdims=True))
        soft /= soft.sum(axis=1, keepdims=True)
        return np.sum(weight * (x @ soft.T))

    slopes = [(relaxed(scores + e) - relaxed(scores - e)) for e in step * np.eye(n)]
    expected = np.array(slopes) / (2 * step)
    got = ours(x, scores, tau, weight)[2]
    # Rounding of the losses, divided by the step.
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-8 / tau)


@pytest.mark.parametrize("shape", [(), (2, 1, 3), (0,)])
def test_any_leading_dimensions(shape, double):
    rng = np.random.default_rng(2)
    x, weight = rng.normal(size=(2, *shape, 7))
    scores = rng.normal(size=7)
    got = ours(x, scores, 0.1, weight)
    for a, b in zip(got, theirs(x, scores, 0.1, weight), strict=True):
        assert_close(a, b)


@pytest.mark.parametrize(
    ("x", "scores", "tau"),
    [
        (jnp.ones((2, 3)), jnp.ones(4), 1.0),
        (jnp.ones(()), jnp.ones(1), 1.0),
        (jnp.ones((2, 3)), jnp.ones((1, 3)), 1.0),
        (jnp.ones((2, 3)), jnp.ones(3), jnp.ones(1)),
        (jnp.ones((2, 3), int), jnp.ones(3), 1.0),
        (jnp.ones((2, 3)), jnp.ones(3, int), 1.0),
    ],
)
def test_what_does_not_fit_is_refused(x, scores, tau):
    with pytest.raises(AssertionError):
        permute(x, scores, tau)
    with pytest.raises(AssertionError):
        jax.eval_shape(permute, x, scores, tau)  # known without computing


@pytest.mark.parametrize("tau", [0.0, -1.0, math.nan, math.inf, 1e-50, np.zeros(())])
def test_a_temperature_that_is_none_is_refused(tau):
    with pytest.raises(ValueError, match="tau"):
        permute(jnp.ones(3), jnp.arange(3.0), tau)


@pytest.mark.parametrize(
    "scores",
    [
        [math.nan, -math.nan, 1.0, -1.0],
        [1.0, math.nan, 0.0, -math.inf, math.inf, math.nan, -0.0, 0.0],
        [-math.nan] * 3,
    ],
)
def test_scores_that_are_no_numbers_come_last(scores):
    scores = jnp.asarray(scores)
    x = jnp.arange(len(scores)) + 0.5
    np.testing.assert_array_equal(permute(x, scores, 1.0), x[jnp.argsort(scores)])


def test_ties_keep_their_place():
    x = jnp.arange(5.0)
    scores = jnp.array([1.0, 0.0, 1.0, -0.0, 1.0])
    np.testing.assert_array_equal(permute(x, scores, 0.1), [1, 3, 0, 2, 4])


def test_vmap_over_modes_and_members(double):
    members, modes, batch, n = 3, 2, 4, 7
    rng = np.random.default_rng(3)
    x, weight = rng.normal(size=(2, members, batch, n))
    scores = rng.normal(size=(members, modes, n))
    taus = np.array(TAUS)

    over_modes = jax.vmap(ours, (None, 0, None, None))
    got = jax.vmap(over_modes)(x, scores, taus, weight)
    for m in range(members):
        for k in range(modes):
            expected = theirs(x[m], scores[m, k], taus[m], weight[m])
            for a, b in zip(got, expected, strict=True):
                assert_close(a[m, k], b)


def test_vmap_over_scores_alone(double):
    # The other axes of vmap: one x for all, and x's batch as the mapped axis.
    rng = np.random.default_rng(4)
    x, scores = rng.normal(size=(5, 7)), rng.normal(size=(5, 7))
    got = jax.vmap(permute, (0, 0, None))(x, scores, 0.1)
    np.testing.assert_array_equal(
        got, np.take_along_axis(x, np.argsort(scores, axis=1), axis=1)
    )
    got = jax.vmap(permute, (None, 0, None))(x, scores, 0.1)
    np.testing.assert_array_equal(got, np.stack([x[:, np.argsort(v)] for v in scores]))
    got = jax.vmap(permute, (1, None, None), out_axes=1)(x[:, None], scores[0], 0.1)
    np.testing.assert_array_equal(got[:, 0], x[:, np.argsort(scores[0])])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
@pytest.mark.parametrize("n", [1, 256])
def test_narrow_types(dtype, n):
    rng = np.random.default_rng(5)
    x, weight = rng.normal(size=(2, 5, n)).astype(dtype)
    scores = rng.normal(size=n).astype(np.float32)
    value, x_gradient, gradient = ours(x, scores, 0.5, weight)
    assert (value.dtype, x_gradient.dtype) == (dtype, dtype)
    assert gradient.dtype == jnp.float32
    order = np.argsort(scores)
    # Values and their gradients are moved, not computed: no rounding.
    np.testing.assert_array_equal(value, x[:, order])
    np.testing.assert_array_equal(x_gradient[:, order], weight)
    # The score gradient of bfloat16 x is summed in float32.
    wide = [a.astype(np.float32) for a in (x, weight)]
    expected = theirs(wide[0], scores, 0.5, wide[1])[2]
    assert_close(gradient, expected, rtol=2e-5, floor=1e-2)


def test_scores_of_narrow_type_keep_it():
    x = jnp.arange(4.0)
    scores = jnp.array([0.5, -1.0, 2.0, 0.25], jnp.bfloat16)
    gradient = jax.jit(jax.grad(lambda v: jnp.sum(permute(x, v, 1.0) ** 2)))(scores)
    assert gradient.dtype == jnp.bfloat16
    assert np.any(np.asarray(gradient, np.float32) != 0)


@pytest.mark.parametrize("tau", [0.5, np.float32(0.5)])
def test_tau_gets_no_gradient(tau):
    x, scores = jnp.arange(7.0), jnp.cos(jnp.arange(7.0))

    def loss(x, scores, tau):
        return jnp.sum(permute(x, scores, tau) ** 2 * x)

    got = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(x, scores, tau)
    assert got[2] == 0
    assert np.all(np.isfinite(np.asarray(got[0])))
    assert np.any(np.asarray(got[1]) != 0)


def test_tau_may_be_traced_or_whole():
    x, scores = jnp.arange(7.0), jnp.cos(jnp.arange(7.0))

    @jax.jit
    def gradient(tau):
        return jax.grad(lambda v: jnp.sum(permute(x, v, tau) * x))(scores)

    np.testing.assert_allclose(
        jax.vmap(gradient)(jnp.array([1.0, 2.0])),
        jnp.stack([gradient(1), gradient(2)]),
        rtol=1e-5,
    )


def test_tau_may_be_a_constant_of_a_compiled_function():
    x, scores = np.arange(7.0), np.cos(np.arange(7.0))

    def loss(scores, tau):
        return jnp.sum(permute(x, scores, tau) * x)

    expected = jax.grad(loss)(scores, 0.5)
    got = jax.grad(jax.jit(lambda v: loss(v, 0.5)))(scores)
    np.testing.assert_allclose(got, expected, rtol=1e-4)


def test_one_neuron_has_nothing_to_learn():
    gradient = jax.grad(lambda v: jnp.sum(permute(jnp.ones((3, 1)), v, 0.1)))(
        jnp.array([0.7])
    )
    np.testing.assert_array_equal(gradient, [0.0])


def numbers_in(jaxpr):
    """The sizes of all arrays that a jaxpr makes, at any depth."""
    for equation in jaxpr.eqns:
        yield from (out.aval.size for out in equation.outvars)
        for inner in jaxprs_in_params(equation.params):
            yield from numbers_in(inner)


def test_memory_grows_with_the_batch_not_with_the_square():
    batch, n = 8, 2048
    x, scores = jnp.ones((batch, n)), jnp.arange(float(n))

    def arrays(function):
        both = functools.partial(value_and_gradients, function)
        return jax.make_jaxpr(both)(x, scores, 0.1, x)

    assert max(numbers_in(arrays(dense).jaxpr)) >= n * n
    # Blocks of b places: n b numbers within them, and (n / b)² between them.
    assert max(numbers_in(arrays(permute).jaxpr)) <= n * n / 8

    def temporary(function):
        both = functools.partial(value_and_gradients, function)
        compiled = jax.jit(both).lower(x, scores, 0.1, x).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert temporary(dense) > 4 * n * n
    assert temporary(permute) < 4 * n * n / 4


@pytest.mark.parametrize("n", [1, 2, 7, 256, 5000])
def test_order_is_a_stable_sort_of_any_floats(n):
    rng = np.random.default_rng(n)
    specials = [0.0, -0.0, 1e-45, -1e-45, 1e38, -1e38, 0.5, np.inf, -np.inf]
    for scores in (
        rng.normal(size=n),
        rng.integers(-3, 3, n),
        1e-40 * rng.normal(size=n),
        0.5 + 1e-7 * rng.integers(0, 9, n),
        rng.choice(specials, n),
    ):
        scores = scores.astype(np.float32)
        got = permute(jnp.arange(n, dtype=jnp.float32), jnp.asarray(scores), 1.0)
        # XLA takes numbers too small for a full mantissa for 0, here as elsewhere.
        scores[np.abs(scores) < np.finfo(np.float32).tiny] = 0
        np.testing.assert_array_equal(got, np.argsort(scores, kind="stable"))
