"""Curves over training: what is drawn, and what the band is."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from rewire_jax.reports.training_curve_plot import Curve, evolution

X = np.array([10.0, 20.0, 30.0])
BLUE, GREEN = [0, 0.447, 0.698], [0, 0.62, 0.451]


def test_band_is_the_interval_of_the_mean_at_every_point() -> None:
    values = np.array([[0.0, 1.0, 5.0], [2.0, 1.0, 5.5], [9.0, 1.0, 4.0]])
    curve = Curve("one", X, values)
    np.testing.assert_array_equal(curve.median, [2, 1, 5])
    np.testing.assert_allclose(curve.mean, values.sum(axis=0) / 3)
    # All 27 draws of three seeds are equally likely.
    draws = [
        values[list(d)].mean(axis=0) for d in itertools.product(range(3), repeat=3)
    ]
    low, high = np.quantile(draws, [0.025, 0.975], axis=0, method="inverted_cdf")
    np.testing.assert_allclose(curve.interval, [low, high])


def test_one_seed_has_no_band_and_what_is_missing_no_statistics() -> None:
    assert np.isnan(Curve("one", X, np.ones((1, 3))).interval).all()
    values = np.array([[1.0, np.nan, 1.0], [1.0, 2.0, 1.0]])
    curve = Curve("one", X, values)
    for each in (curve.median, curve.mean, *curve.interval):
        np.testing.assert_array_equal(each, [1, np.nan, 1])


def painted(path: Path, colour: list[float]) -> np.ndarray:
    """Pixels of a line's colour, `[rows, columns]`."""
    return np.abs(imread(path)[..., :3] - colour).max(axis=2) < 0.02


def test_a_curve_looks_the_same_in_every_panel(tmp_path: Path) -> None:
    first, second = (Curve(n, X, np.full((2, 3), v)) for n, v in (("a", 1), ("b", 2)))
    path = tmp_path / "panels.png"
    evolution([[first], [second, first]], "quantity", "title", path)
    half = imread(path).shape[1] // 2
    blue, green = painted(path, BLUE), painted(path, GREEN)
    assert blue[:, :half].any()
    assert blue[:, half:].any()
    assert not green[:, :half].any()
    assert green[:, half:].any()
    # With one scale for both panels, equal values are equally high.
    rows = [np.median(np.nonzero(side)[0]) for side in (blue[:, :half], blue[:, half:])]
    assert abs(rows[0] - rows[1]) <= 2


@pytest.mark.parametrize("first", [0.0, 1e-3])
def test_zero_has_no_place_on_a_logarithmic_scale(tmp_path: Path, first: float) -> None:
    values, whole = np.tile([first, 1.0, 10.0], (2, 1)), np.ones((2, 3))
    path = tmp_path / "log.png"
    curves = Curve("a", X, values), Curve("b", X, whole)
    evolution([curves], "quantity", "title", path, log=True)
    blue, green = (painted(path, c).any(axis=0).sum() for c in (BLUE, GREEN))
    assert (blue > 0.8 * green) == (first > 0)
    assert blue > 0.3 * green
