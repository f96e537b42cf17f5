"""What pictures and tables write in numbers, and what pictures show."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from rewire_jax.core import formatting
from rewire_jax.reports import plots
from rewire_jax.reports.interval_plot import intervals
from rewire_jax.reports.matrix_plot import Matrix, matrices
from rewire_jax.reports.sequence_plot import Training, curves
from rewire_jax.reports.spread import Interval
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
    lines = [Matrix(f"method {i}", scores + i) for i in range(count)]
    path = tmp_path / "matrix.png"
    matrices(lines, ("one", "two"), RETURN, "title", path)
    image = imread(path)[..., :3]
    # Every method's frames are there, two a map.
    orange = np.abs(image - [0.835, 0.369, 0]).max(axis=2) < 0.02
    single = tmp_path / "single.png"
    matrices(lines[:1], ("one", "two"), RETURN, "title", single)
    first = np.abs(imread(single)[..., :3] - [0.835, 0.369, 0]).max(axis=2) < 0.02
    assert orange.sum() > 0.3 * count * first.sum() > 0


def test_curves_start_anew_at_each_task(tmp_path: Path) -> None:
    x = np.array([50.0, 100.0])
    high, low = np.full((2, 2), 9.0), np.zeros((2, 2))
    missing = np.full((2, 2), np.nan)
    pictures = []
    for k, stages in enumerate(([high, low], [high, missing], [missing, missing])):
        line = Training("one", [(x, r) for r in stages])
        path = tmp_path / f"{k}.png"
        curves([line], ("one", "two"), 100, RETURN, "title", path)
        image = imread(path)[..., :3]
        blue = np.abs(image - [0, 0.447, 0.698]).max(axis=2) < 0.02
        pictures.append(blue[:, : int(0.8 * blue.shape[1])].sum())  # no legend
    assert pictures[0] > pictures[1] > pictures[2] == 0


def colour(path: Path, place: int) -> np.ndarray:
    """Where a picture has the colour of a method."""
    return (
        np.abs(imread(path)[..., :3] - to_rgb(plots.look(place)["color"])).max(2) < 0.02
    )


@pytest.mark.parametrize(("count", "panels"), [(6, 1), (7, 7)])
def test_many_methods_have_a_panel_each(count: int, panels: int) -> None:
    drawn: dict[int, list[tuple[int, bool]]] = {}

    def draw(axes: Axes, place: int, style: Mapping[str, Any], band: float) -> None:
        coloured = style["color"] == plots.look(place)["color"]
        assert coloured == (band > 0)
        drawn.setdefault(id(axes), []).append((place, coloured))

    labels = [str(i) for i in range(count)]
    _, axes = plots.methods_figure(labels, (9, 5), draw)
    assert len(axes) == len(drawn) == panels
    for i, panel in enumerate(map(id, axes)):
        assert {place for place, _ in drawn[panel]} == set(range(count))
        coloured = [place for place, coloured in drawn[panel] if coloured]
        assert coloured == ([*range(count)] if panels == 1 else [i])
        # The method of the panel is above the others.
        assert drawn[panel][-1][1]


@pytest.mark.parametrize("count", [2, 8])
def test_curves_of_any_number_of_methods(tmp_path: Path, count: int) -> None:
    x = np.array([50.0, 100.0])
    trained = [Training(str(i), [(x, np.full((2, 2), i))] * 2) for i in range(count)]
    path = tmp_path / "curves.png"
    curves(trained, ("one", "two"), 100, RETURN, "title", path)
    # Text and frames have the colours of places 3 and 7.
    places = set(range(count)) - {3, 7}
    assert all(colour(path, i).sum() > 100 for i in places)


def test_intervals_are_sorted_and_as_long_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "iqm.png"
    values = [
        ("low", Interval(1.0, 0.5, 1.5)),
        ("high", Interval(2.0, 1.0, 3.0)),
        ("none", Interval(None, None, None)),
        ("black as the text", Interval(None, None, None)),
        ("middle", Interval(1.5, None, None)),
    ]
    intervals(values, "mean", "title", path)
    low, high, none, _, middle = (np.argwhere(colour(path, i)) for i in range(5))
    rows = [np.median(each[:, 0]) for each in (high, middle, low)]
    assert rows == sorted(set(rows))
    assert not none.size
    widths = [np.ptp(each[:, 1]) for each in (low, high)]
    assert widths[1] == pytest.approx(2 * widths[0], rel=0.1)
    # The interval of the second one begins where the value of the first one is.
    middle_of_low = (low[:, 1].min() + low[:, 1].max()) / 2
    assert high[:, 1].min() == pytest.approx(middle_of_low, abs=2)
