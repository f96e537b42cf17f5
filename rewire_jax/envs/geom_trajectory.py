"""The motion of an episode, to be rendered: geometries of a MuJoCo model."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_HIDDEN = 3  # MuJoCo shows the geometry groups below this number.
_PLANE = 0  # mujoco.mjtGeom.mjGEOM_PLANE, without importing mujoco


class Film(NamedTuple):
    """The poses of all geometries in an episode, frame by frame.

    Attributes:
      model: `mujoco.MjModel`; it gives shapes and colours, not poses.
      seconds: time between two frames.
      position: `[frames, geoms, 3]` in metres.
      rotation: `[frames, geoms, 3, 3]`, from a geometry's own axes to the world's.
    """

    model: Any
    seconds: float
    position: Array
    rotation: Array


def solids(film: Film) -> Array:
    """Indices of the visible geometries, except planes such as the floor."""
    model = film.model
    shown = (model.geom_group < _HIDDEN) & (model.geom_rgba[:, 3] > 0)
    return np.flatnonzero(shown & (model.geom_type != _PLANE))


def movable(film: Film) -> Array:
    """Indices of the solids that belong to bodies with joints."""
    model, some = film.model, solids(film)
    return some[model.body_weldid[model.geom_bodyid[some]] > 0]


def colour(film: Film, geom: int) -> Array:
    """`[4]`, red, green, blue and opacity in [0, 1], by MuJoCo's rule."""
    model = film.model
    own, material = model.geom_rgba[geom], model.geom_matid[geom]
    default = np.array_equal(own, [0.5, 0.5, 0.5, 1.0])
    return model.mat_rgba[material] if material >= 0 and default else own


def gaze(film: Film) -> tuple[Array, float]:
    """The point that a camera looks at, `[frames, 3]`, and the size of what it shows.

    The point follows a body that walks away, in the plane. Otherwise it does not move.
    """
    moving = movable(film)
    some = moving if len(moving) else solids(film)
    centre = film.position[:, some].mean(axis=1)
    reach = np.linalg.norm(film.position[0, some] - centre[0], axis=1)
    size = float((reach + film.model.geom_rbound[some]).max())
    centre[:, 2] = centre[:, 2].mean()
    if np.ptp(centre, axis=0).max() < size:
        centre[:] = centre.mean(axis=0)
    return centre, size
