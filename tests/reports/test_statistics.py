"""Statistics: by hand, by brute force, and against rliable's numbers."""

import json
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from rewire_jax.reports import statistics
from rewire_jax.reports.statistics import (
    estimate,
    interquartile_mean,
    normalised_iqm,
    performance_profile,
    probability_of_improvement,
    stratified_bootstrap,
)

# Written by experiments/rliable_numbers.py.
RLIABLE = json.loads((Path(__file__).parents[1] / "data/rliable.json").read_text())
SCORES = {name: np.array(scores) for name, scores in RLIABLE["scores"].items()}
METHODS = ("a", "b", "c")

interval = partial(stratified_bootstrap, interquartile_mean)


def agrees(of, theirs, *samples, step: float = 0.0) -> None:
    """The value is rliable's, and so is its interval but for the drawing.

    `step` is between two possible values.
    """
    (value,) = np.atleast_2d(of(*samples))
    np.testing.assert_allclose(value, theirs["value"], rtol=0, atol=1e-12)
    low, high = ends = np.array(theirs["interval"])
    ours = stratified_bootstrap(of, *samples).reshape(ends.shape)
    error = 1.001 * step or 0.03 * (high - low).max()
    np.testing.assert_allclose(ours, ends, rtol=0, atol=error)


@pytest.mark.parametrize("name", METHODS)
def test_interquartile_means_are_those_of_rliable(name: str) -> None:
    agrees(interquartile_mean, RLIABLE["iqm"][name], SCORES[name])


@pytest.mark.parametrize("name", METHODS)
def test_the_spread_of_the_reference_is_carried_through(name: str) -> None:
    samples = SCORES[name], SCORES["normaliser"]
    theirs = RLIABLE["normalised_iqm"][name]
    agrees(normalised_iqm, theirs, *samples)
    # With the reference held fixed, intervals are narrower than rliable's.
    fixed = interval(SCORES[name] / SCORES["normaliser"].mean())
    assert np.ptp(fixed) < 0.99 * np.ptp(theirs["interval"])


@pytest.mark.parametrize("name", METHODS)
def test_profiles_are_those_of_rliable(name: str) -> None:
    profile = partial(performance_profile, thresholds=RLIABLE["thresholds"])
    scores = SCORES[name]
    agrees(profile, RLIABLE["profile"][name], scores, step=1 / scores.size)


@pytest.mark.parametrize("pair", RLIABLE["improvement"])
def test_probabilities_of_improvement_are_those_of_rliable(pair: str) -> None:
    samples = [SCORES[name] for name in pair.split()]
    agrees(probability_of_improvement, RLIABLE["improvement"][pair], *samples)


def test_known_profile_and_probability_of_improvement() -> None:
    scores = [[1.0, 2.0], [2.0, 4.0]]
    # A score at the threshold is not above it.
    shares = performance_profile(scores, [0.0, 1.0, 2.0, 3.9, 4.0])
    np.testing.assert_array_equal(shares, [1.0, 0.75, 0.25, 0.25, 0.0])
    # Task 0: 1 of 2 pairs is a win, the other one a tie; task 1: no win.
    other = [[1.0, 9.0]]
    assert probability_of_improvement(scores, other) == (0.75 + 0.0) / 2
    assert probability_of_improvement(other, scores) == (0.25 + 1.0) / 2


def test_an_estimate_has_its_interval_where_there_is_one() -> None:
    several = estimate(interquartile_mean, SCORES["a"])
    assert several.value == interquartile_mean(SCORES["a"])
    assert several.low < several.value < several.high
    one = estimate(normalised_iqm, SCORES["a"], SCORES["normaliser"][:1])
    assert one.value > 0
    assert (one.low, one.high) == (None, None)
    assert estimate(interquartile_mean, np.zeros((0, 3))).value is None


@pytest.mark.parametrize(
    ("values", "middle"),
    [
        ([3.0], 3),
        ([1, 9], 5),  # a quarter of two is less than one value
        ([100, 2, 4, -50], 3),
        ([7, 7, 7, 7, 7], 7),
        ([0, 5, 5, 5, 5, 5, 5, 900], 5),
        ([8, 1, 2, 3, 4, 5, 6, 7], 4.5),
        ([1, 2, np.nan, 4], np.nan),
    ],
)
def test_known_interquartile_means(values: list[float], middle: float) -> None:
    seeds = np.array(values)[:, None]
    np.testing.assert_allclose(statistics.interquartile_mean(seeds), middle)
    twice = statistics.interquartile_mean(np.stack([seeds, seeds[::-1]]))
    np.testing.assert_allclose(twice, [middle, middle])


def test_bootstrap_resamples_seeds_within_each_task() -> None:
    # Two seeds, two tasks, far apart: 2 × 2 draws of each task, 16 in all. Of the four
    # drawn values the middle two are the larger of task 0 and the smaller of task 1,
    # unless both draws of a task are the same seed.
    scores = np.array([[0.0, 100.0], [4.0, 112.0]])
    exact = sorted(
        (max(scores[a, 0], scores[b, 0]) + min(scores[c, 1], scores[d, 1])) / 2
        for a, b, c, d in product((0, 1), repeat=4)
    )
    np.testing.assert_array_equal(interval(scores), [exact[0], exact[-1]])
    # Half of the draws: the quartiles of all sixteen.
    inner = interval(scores, level=0.5)
    np.testing.assert_array_equal(inner, [exact[4], exact[11]])


def test_bootstrap_of_ties_single_tasks_and_single_seeds() -> None:
    np.testing.assert_array_equal(interval(np.full((3, 2), 5.0)), [5, 5])
    assert interval([[1.0, 2.0]]) is None
    assert interval(np.zeros((0, 2))) is None
    low, high = interval(np.arange(9.0)[:, None])
    assert 0 < low < 4 < high < 8


def test_bootstrap_covers_the_truth_and_repeats_itself() -> None:
    random = np.random.default_rng(0)
    hits, widths = 0, {8: 0.0, 32: 0.0}
    for seeds in widths:
        for _ in range(60):
            scores = random.normal(3.0, 1.0, (seeds, 4))
            low, high = interval(scores, resamples=500)
            hits += seeds == 32 and low < 3 < high
            widths[seeds] += high - low
    assert hits >= 51  # of 60, 57 expected
    # Four times the seeds halve the interval.
    assert widths[8] / widths[32] == pytest.approx(2, rel=0.15)
    again = interval(scores, resamples=500)
    np.testing.assert_array_equal(again, interval(scores, resamples=500))
    assert (again != interval(scores, resamples=500, seed=1)).any()
