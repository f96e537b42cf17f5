"""Metrics on hand-made matrices with known answers."""

import numpy as np
import pytest

from rewire_jax.reports import metrics

# Rows: after training task 0, 1, 2. Columns: the task evaluated.
MATRIX = np.array([[10.0, 1.0, 0.0], [7.0, 20.0, 2.0], [4.0, 25.0, 30.0]])


def test_known_matrix() -> None:
    np.testing.assert_array_equal(metrics.final(MATRIX), [4, 25, 30])
    np.testing.assert_array_equal(metrics.after_own_training(MATRIX), [10, 20, 30])
    np.testing.assert_array_equal(metrics.forgetting(MATRIX), [-6, 5, 0])
    assert metrics.performance(MATRIX) == pytest.approx(59 / 3)


def test_leading_axes_are_independent() -> None:
    many = np.stack([[MATRIX, 2 * MATRIX], [MATRIX + 1, -MATRIX]])
    assert metrics.performance(many).shape == (2, 2)
    np.testing.assert_array_equal(metrics.forgetting(many)[0, 1], [-12, 10, 0])
    np.testing.assert_array_equal(metrics.forgetting(many)[1, 0], [-6, 5, 0])
    np.testing.assert_array_equal(metrics.final(many)[1, 1], [-4, -25, -30])


def test_single_task_is_never_forgotten() -> None:
    np.testing.assert_array_equal(metrics.forgetting([[3.0]]), [0.0])
    assert metrics.performance([[3.0]]) == 3.0


def test_missing_scores_stay_missing() -> None:
    matrix = MATRIX.copy()
    matrix[2, 0] = np.nan
    np.testing.assert_array_equal(metrics.forgetting(matrix), [np.nan, 5, 0])
    assert np.isnan(metrics.performance(matrix))


def test_unfinished_sequence_has_no_diagonal() -> None:
    with pytest.raises(ValueError, match="2 stages for 3 tasks"):
        metrics.after_own_training(MATRIX[:2])
    np.testing.assert_array_equal(metrics.final(MATRIX[:2]), [7, 20, 2])


def test_known_normalisation_and_transfer() -> None:
    # One divisor for all tasks, though the reference fails on the first.
    reference = [-10.0, 10.0, 30.0]
    normal = metrics.normalise(MATRIX, reference)
    np.testing.assert_allclose(normal, MATRIX / 10)
    assert metrics.performance(normal) == pytest.approx(59 / 30)
    np.testing.assert_allclose(metrics.forgetting(normal), [-0.6, 0.5, 0])
    np.testing.assert_allclose(
        metrics.forward_transfer(normal, [0.5, 2.0, 4.0]), [0.5, 0, -1]
    )
    np.testing.assert_allclose(
        metrics.forward_transfer([[[3.0]], [[5.0]]], [4]), [[-1], [1]]
    )


@pytest.mark.parametrize("reference", [[-1.0, 1.0], [-3.0], [np.nan, 1.0]])
def test_nothing_is_normalised_by_what_is_not_positive(reference: list[float]) -> None:
    with pytest.raises(ValueError, match="cannot normalise"):
        metrics.normalise(np.ones((1, len(reference))), reference)


def test_the_reference_is_one_without_transfer_or_ties_broken() -> None:
    normal = metrics.normalise(MATRIX, metrics.final(MATRIX))
    assert metrics.performance(normal) == pytest.approx(1)
    own = metrics.after_own_training(normal)
    np.testing.assert_array_equal(metrics.forward_transfer(normal, own), [0, 0, 0])
    ties = np.full((2, 3, 3), 7.0)
    np.testing.assert_array_equal(metrics.forgetting(ties), np.zeros((2, 3)))


def test_area_weights_reports_by_the_interactions_since_the_last() -> None:
    # 100 interactions at 0.2, 300 at 0.6, 100 at 1: by hand (20 + 180 + 100) / 500.
    at = [100, 400, 500]
    assert metrics.area(at, [0.2, 0.6, 1.0]) == pytest.approx(0.6)
    # A report that saw no episode has no part in it, nor have its interactions.
    seen = [[0.2, np.nan, 1.0], [np.nan, 0.6, 1.0], [np.nan] * 3, [0.5] * 3]
    np.testing.assert_allclose(metrics.area(at, seen), [0.6, 0.7, np.nan, 0.5])
    # However finely it is reported, a step curve has the same area.
    fine = np.arange(1, 501)
    steps = np.where(fine <= 100, 0.2, np.where(fine <= 400, 0.6, 1.0))
    assert metrics.area(fine, steps) == pytest.approx(0.6)
    assert np.isnan(metrics.area([], []))


def test_known_transfer_by_area() -> None:
    alone = [0.5, 0.8, 0.0, 1.0]
    areas = [[0.75, 0.8, 0.3, 1.0], [1.0, 0.6, 0.0, 0.9]]
    np.testing.assert_allclose(
        metrics.area_transfer(areas, alone),
        [[0.5, 0.0, 0.3, np.nan], [1.0, -1.0, 0.0, np.nan]],
    )
    np.testing.assert_array_equal(
        metrics.area_transfer([0.5, np.nan], [np.nan, 0.5]), [np.nan, np.nan]
    )
