"""Labels of the scatter stay apart."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.transforms import Bbox

from rewire_jax.reports.tradeoff_plot import Point, place, tradeoff

AREA = Bbox([[0, 0], [800, 500]])


@pytest.mark.parametrize("spread", [0, 5, 60, 400])
def test_labels_overlap_neither_each_other_nor_points(spread: float) -> None:
    random = np.random.default_rng(0)
    points = np.array([400, 250]) + random.uniform(-spread, spread, (12, 2)) / 2
    sizes = np.stack([random.uniform(30, 130, 12), np.full(12, 14.0)], axis=1)
    taken = [Bbox([point - 6, point + 6]) for point in points]
    boxes = place(points, sizes, taken, AREA)
    for one, other in itertools.combinations([*boxes, *taken[:1]], 2):
        assert not one.overlaps(other)
    for box, size in zip(boxes, sizes, strict=True):
        np.testing.assert_allclose([box.width, box.height], size)
        assert AREA.x0 <= box.x0
        assert box.x1 <= AREA.x1
        assert AREA.y0 <= box.y0
        assert box.y1 <= AREA.y1


def test_a_lonely_label_is_to_the_right_and_near() -> None:
    (box,) = place(np.array([[400.0, 250]]), np.array([[50.0, 14]]), [], AREA)
    assert 400 < box.x0 < 420
    assert (box.y0 + box.y1) / 2 == 250
    # At the right edge there is no room for it there.
    (box,) = place(np.array([[790.0, 250]]), np.array([[50.0, 14]]), [], AREA)
    assert box.x1 < 790


def test_points_without_a_performance_are_left_out(tmp_path: Path) -> None:
    pictures = []
    for k, extra in enumerate(([], [Point("none", 3.0, float("nan"), None)])):
        path = tmp_path / f"{k}.png"
        tradeoff([Point("one", 2.0, 0.5, 0.1), *extra], "÷ SAC-N", "title", path)
        pictures.append(imread(path))
    np.testing.assert_array_equal(*pictures)
    tradeoff([Point("none", 3.0, float("nan"), None)], "÷ SAC-N", "title", path)
    assert (imread(path) != pictures[0]).any()
