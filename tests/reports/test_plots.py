"""What pictures and tables write in numbers, and how methods look."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from rewire_jax.core import formatting
from rewire_jax.reports import plots
from rewire_jax.storage.scores import RETURN


def test_nine_methods_have_nine_colours_and_more_have_other_lines() -> None:
    looks = [plots.look(i) for i in range(18)]
    assert len({look["color"] for look in looks[:9]}) == 9
    assert len({tuple(look.values()) for look in looks}) == 18


@pytest.mark.parametrize(
    ("value", "scale", "text"),
    [
        (None, None, "–"),
        (np.nan, None, "–"),
        (1234.5, None, "1,234"),
        (-12.34, None, "-12.3"),
        (0.126, None, "0.13"),
        (-0.001, None, "0.00"),
        (0.126, 500.0, "0"),
    ],
)
def test_numbers(value: float | None, scale: float | None, text: str) -> None:
    assert formatting.number(value, scale) == text


def test_mean_passes_over_what_is_missing() -> None:
    values = np.array([[1.0, np.nan, np.nan], [3.0, 5.0, np.nan]])
    np.testing.assert_array_equal(plots.mean(values), [2, 5, np.nan])


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_maps_of_any_number_of_methods(tmp_path: Path, count: int) -> None:
    scores = np.arange(6.0).reshape(1, 3, 2)
    lines = [plots.Line(f"method {i}", [], scores + i) for i in range(count)]
    path = tmp_path / "matrix.png"
    plots.matrices(lines, ("one", "two"), RETURN, "title", path)
    image = imread(path)[..., :3]
    # Every method's frames are there, two a map.
    orange = np.abs(image - [0.835, 0.369, 0]).max(axis=2) < 0.02
    single = tmp_path / "single.png"
    plots.matrices(lines[:1], ("one", "two"), RETURN, "title", single)
    first = np.abs(imread(single)[..., :3] - [0.835, 0.369, 0]).max(axis=2) < 0.02
    assert orange.sum() > 0.3 * count * first.sum() > 0


def test_curves_start_anew_at_each_task(tmp_path: Path) -> None:
    x = np.array([50.0, 100.0])
    high, low = np.full((2, 2), 9.0), np.zeros((2, 2))
    missing = np.full((2, 2), np.nan)
    pictures = []
    for k, stages in enumerate(([high, low], [high, missing], [missing, missing])):
        line = plots.Line("one", [(x, r) for r in stages], np.zeros((2, 3, 2)))
        path = tmp_path / f"{k}.png"
        plots.curves([line], ("one", "two"), 100, RETURN, "title", path)
        image = imread(path)[..., :3]
        blue = np.abs(image - [0, 0.447, 0.698]).max(axis=2) < 0.02
        pictures.append(blue[:, : int(0.8 * blue.shape[1])].sum())  # no legend
    assert pictures[0] > pictures[1] > pictures[2] == 0
