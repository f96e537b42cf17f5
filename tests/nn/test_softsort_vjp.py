import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.nn.softsort_vjp import score_gradient

TAUS = (1.0, 0.1, 0.01, 0.001)


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def sorted_scores(n, rng):
    """Many kinds, among them ties within blocks and across their edges."""
    return np.sort(
        [
            np.arange(n) / max(n - 1, 1),
            rng.random(n),
            rng.integers(0, max(n // 2, 2), n) / 4,
            rng.integers(0, 3, n) / 4,
            np.full(n, 0.3),
            -1 - 3 * rng.random(n),
            1e8 * rng.normal(size=n),
        ],
        axis=1,
    )


def dense(gradients, permuted, ordered, tau):
    """Slope of sum(Q * A) by automatic differentiation, with n x n matrices."""
    product = sum(g @ x.T for g, x in zip(gradients, permuted, strict=True))

    def total(ordered):
        difference = ordered[:, None] - ordered[None, :]
        soft = jax.nn.softmax(-jnp.abs(difference) / tau, axis=-1)
        return jnp.sum(soft * product)

    return jax.grad(total)(ordered)


def over_kinds_and_temperatures(function, *arrays):
    one = jax.vmap(functools.partial(function, *arrays), (None, 0))
    return jax.jit(jax.vmap(one, (0, None)))


@pytest.mark.parametrize("n", [1, 2, 7, 45, 256])
def test_equals_the_dense_form_whatever_the_blocks(n, double):
    rng = np.random.default_rng(n)
    gradients, permuted = ([rng.normal(size=(n, m)) for m in (3, 1)] for _ in range(2))
    scores, taus = sorted_scores(n, rng), np.array(TAUS)
    expected = over_kinds_and_temperatures(dense, gradients, permuted)(scores, taus)
    terms = sum(
        np.max(np.abs(g @ x.T)) for g, x in zip(gradients, permuted, strict=True)
    )
    # Where the neighbours are many tau away, all that is left is rounding.
    size = np.max(np.abs(expected), axis=-1) + 1e-5 * terms / taus
    for block in sorted({1, 4, 16, n}):
        ours = functools.partial(score_gradient, block=block)
        got = over_kinds_and_temperatures(ours, gradients, permuted)(scores, taus)
        assert np.max(np.abs(got - expected) / size[..., None]) < 1e-10
        turned = [[a.T for a in arrays] for arrays in (gradients, permuted)]
        ours = functools.partial(score_gradient, block=block, axis=1)
        got = over_kinds_and_temperatures(ours, *turned)(scores, taus)
        assert np.max(np.abs(got - expected) / size[..., None]) < 1e-10
    # The comparison can fail: all but the last kind have something to learn.
    if n > 2:
        assert np.all(np.max(np.abs(expected), axis=-1)[:-1, 0] > 1e-4 * terms)
