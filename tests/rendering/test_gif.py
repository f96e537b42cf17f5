import itertools
import sys

import numpy as np
import pytest
from PIL import Image

from rewire_jax.core.errors import UserError
from rewire_jax.rendering.gif import write_gif
from tests.rendering.test_webpage import film


def drawn(seen, path, **options):
    """The pictures of a GIF, and how long each is shown in milliseconds."""
    try:
        write_gif(seen, path, **options)
    except UserError as error:
        pytest.skip(str(error))
    pictures, times = [], []
    with Image.open(path) as gif:
        for frame in range(gif.n_frames):
            gif.seek(frame)
            pictures.append(np.asarray(gif.convert("RGB")).astype(int))
            times.append(gif.info["duration"])
    return pictures, times


def test_an_animation_moves_as_fast_as_the_film(tmp_path) -> None:
    seen = film(2.0, frames=101)._replace(seconds=0.015)
    size = {"width": 120, "height": 80}
    pictures, times = drawn(seen, tmp_path / "x.gif", seconds=0.88, **size)
    assert {picture.shape for picture in pictures} == {(80, 120, 3)}
    # Every third frame, 45 ms, in ticks of 10 ms.
    assert len(pictures) == 20
    assert sum(times) == 900
    assert set(times) == {40, 50}
    assert all((a != b).any() for a, b in itertools.pairwise(pictures))
    assert pictures[0].std() > 10


def test_without_a_way_to_draw_a_line_says_so(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(UserError, match="set MUJOCO_GL") as error:
        write_gif(film(1.0), tmp_path / "x.gif", seconds=1.0)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())
