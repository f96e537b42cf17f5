"""Metrics on hand-made matrices with known answers."""

import numpy as np
import pytest

from rewire_jax import metrics

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
