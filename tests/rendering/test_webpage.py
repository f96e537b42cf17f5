import base64
import json
import re
from html.parser import HTMLParser

import mujoco
import numpy as np
import pytest
import trimesh

from rewire_jax.envs import geom_trajectory as films
from rewire_jax.envs.geom_trajectory import Film
from rewire_jax.rendering import webpage

MODEL = """
<mujoco>
  <asset>
    <material name="red" rgba="1 0 0 1"/>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 2"/>
  </asset>
  <worldbody>
    <geom type="plane" size="0 0 1" pos="0 0 -0.5"/>
    <geom type="box" size="0.1 0.1 0.1" pos="9 9 0"/>
    <body>
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3" material="red"/>
      <geom type="sphere" size="0.25" pos="0 0 1"/>
      <geom type="capsule" size="0.1 0.5" rgba="0 1 0 1" material="red"/>
      <geom type="cylinder" size="0.2 0.4"/>
      <geom type="ellipsoid" size="0.1 0.2 0.4"/>
      <geom type="mesh" mesh="wedge"/>
      <geom type="box" size="1 1 1" group="3"/>
      <geom type="box" size="1 1 1" rgba="1 1 1 0"/>
    </body>
  </worldbody>
</mujoco>
"""
SOLID, MOVABLE = [1, 2, 3, 4, 5, 6, 7], [2, 3, 4, 5, 6, 7]


def film(velocity: float, frames: int = 11) -> Film:
    """The body slides along x and turns about z."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    position, rotation = [], []
    for time in np.linspace(0, 1, frames):
        data.qpos[:] = [velocity * time, 0, 0, np.cos(time), 0, 0, np.sin(time)]
        mujoco.mj_kinematics(model, data)
        position.append(data.geom_xpos.copy())
        rotation.append(data.geom_xmat.reshape(-1, 3, 3).copy())
    return Film(model, 0.1, np.array(position), np.array(rotation))


class Loads(HTMLParser):
    """What a page says that a browser is to fetch."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attributes) -> None:
        names = ("src", "href", "data", "action", "srcset")
        self.found += [value for name, value in attributes if name in names]


def embedded(page: str) -> dict:
    """What the player reads."""
    (found,) = re.findall(r'<script id="film"[^>]*>(.*?)</script>', page, re.S)
    return json.loads(found)


def scene(page: str) -> trimesh.Scene:
    """The first frame, read anew from the page."""
    (found,) = re.findall(r'base64_data="([^"]*)"', page)
    return trimesh.load(trimesh.util.wrap_as_stream(base64.b64decode(found)), "glb")


def test_what_is_shown_moves_and_has_its_colour() -> None:
    seen = film(1.0)
    assert films.solids(seen).tolist() == SOLID
    assert films.movable(seen).tolist() == MOVABLE
    # A material colours what has no colour of its own.
    np.testing.assert_allclose(films.colour(seen, 2), [1, 0, 0, 1])
    np.testing.assert_allclose(films.colour(seen, 3), [0.5, 0.5, 0.5, 1])
    np.testing.assert_allclose(films.colour(seen, 4), [0, 1, 0, 1])


def test_the_camera_follows_what_walks_and_rests_on_what_stays() -> None:
    walking, size = films.gaze(film(20.0))
    # Turning about z moves the centre in the plane by less than the size.
    np.testing.assert_allclose(walking[:, 0], np.linspace(0, 20, 11), atol=size)
    assert np.ptp(walking[:, 2]) == 0
    resting, _ = films.gaze(film(0.1))
    assert np.ptp(resting, axis=0).max() == 0
    assert 1 < size < 3  # the wedge reaches up to 2, from its own middle


def test_a_page_shows_each_geometry_as_it_is() -> None:
    page = webpage.to_html(film(1.0), "walk & talk", "return 1 < 2")
    nodes = scene(page)
    assert set(nodes.geometry) == {f"geom{i}" for i in SOLID}
    box = [[2 * x for x in size] for size in ([0.1, 0.2, 0.3], [0.1, 0.2, 0.4])]
    for geom, extents, near in (
        (2, box[0], 1e-6),
        (3, [0.5, 0.5, 0.5], 0.02),
        (4, [0.2, 0.2, 1.2], 0.02),
        (5, [0.4, 0.4, 0.8], 0.02),
        (6, box[1], 0.02),
        (7, [1.0, 1.0, 2.0], 1e-6),
    ):
        mesh = nodes.geometry[f"geom{geom}"]
        # MuJoCo gives a mesh axes of its own; its volume is the same in all.
        if geom == 7:
            assert mesh.volume == pytest.approx(np.prod(extents) / 6, rel=1e-4)
        else:
            np.testing.assert_allclose(mesh.extents, extents, rtol=near, atol=near)
            np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0, atol=1e-6)
    green = nodes.geometry["geom4"].visual.material.baseColorFactor
    assert list(green) == [0, 255, 0, 255]
    assert "walk &amp; talk" in page
    assert "return 1 &lt; 2" in page


def test_a_page_places_what_moves_frame_by_frame() -> None:
    seen = film(3.0)
    found = embedded(webpage.to_html(seen, "", ""))
    assert found["names"] == [f"geom{i}" for i in MOVABLE]
    position, rotation = np.array(found["position"]), np.array(found["rotation"])
    assert position.shape == (11, 6, 3)
    np.testing.assert_allclose(position, seen.position[:, MOVABLE], atol=1e-4)
    x, y, z, w = np.moveaxis(rotation, -1, 0)
    # Half an angle, as the body's own quaternion has it.
    np.testing.assert_allclose(
        np.abs(w[:, 0]), np.cos(np.linspace(0, 1, 11)), atol=1e-4
    )
    np.testing.assert_allclose(x**2 + y**2 + z**2 + w**2, 1, atol=1e-3)
    assert found["floor"] == -0.5
    assert found["seconds"] == 0.1


def test_nothing_is_loaded_to_see_a_page() -> None:
    page = webpage.to_html(film(1.0), "</script><script src='//example.org'>", "")
    assert Loads(page).found == []
    assert "default-src 'none'" in page
    # A name of XML's and a comment's; neither is loaded.
    addresses = set(re.findall(r"https?://[\w.]+", page))
    assert addresses <= {"http://www.w3.org", "https://github.com"}
    assert not re.search(r"\bimport\s*\(|@import|importScripts", page)
