import jax
import numpy as np
import pytest
from scipy import signal, stats

from rewire_jax.training import colored_noise

COLORS = (0.0, 1.0, 2.0)


def draw(color, length, *shape, seed=0):
    return np.asarray(colored_noise.colored(jax.random.key(seed), color, length, shape))


@pytest.mark.parametrize("length", [255, 256])
@pytest.mark.parametrize("color", COLORS)
def test_the_spectrum_falls_as_the_color_says(color, length):
    x = draw(color, length, 500)
    frequency, power = signal.periodogram(x, axis=0, detrend=False)
    # A real coefficient, of the mean or the fastest swing, is not counted twice.
    middle = slice(1, (length + 1) // 2)
    power = np.log(power.mean(axis=1))[middle]
    fit = stats.linregress(np.log(frequency[middle]), power)
    assert fit.slope == pytest.approx(-color, abs=0.03)
    # The mean of 500 exponential variables scatters by 4.5%.
    line = fit.intercept + fit.slope * np.log(frequency[middle])
    assert np.abs(power - line).max() < 0.25


@pytest.mark.parametrize("length", [1, 2, 65])
@pytest.mark.parametrize("color", COLORS)
def test_every_element_is_a_standard_normal(color, length):
    x = draw(color, length, 4000)
    assert x.shape == (length, 4000)
    assert x.dtype == np.float32
    assert np.isfinite(x).all()
    for step in {0, length // 2, length - 1}:
        assert stats.kstest(x[step], "norm").pvalue > 1e-3
    # Sequences are independent, so the squares' mean scatters by at most 0.022.
    assert np.mean(x**2) == pytest.approx(1, abs=0.1)


def test_white_noise_is_not_touched():
    white = jax.random.normal(jax.random.key(0), (50, 3))
    np.testing.assert_allclose(draw(0.0, 50, 3), white, atol=1e-5)


@pytest.mark.parametrize("color", COLORS)
def test_sequences_have_nothing_in_common(color):
    x = draw(color, 64, 2000, 2, 3).reshape(64, 2000, 6)
    products = np.einsum("tni,tnj->ntij", x, x).mean(axis=1)
    mean, error = products.mean(axis=0), products.std(axis=0) / np.sqrt(2000)
    apart = ~np.eye(6, dtype=bool)
    assert (np.abs(mean / error)[apart] < 4).all()
    assert not np.array_equal(x, draw(color, 64, 2000, 2, 3, seed=1).reshape(x.shape))
