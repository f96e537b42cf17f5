"""Writes a film as a GIF, if MuJoCo can draw without a window."""

import contextlib
import copy
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from rewire_jax.core.errors import UserError, writing
from rewire_jax.envs import geom_trajectory as films
from rewire_jax.envs.geom_trajectory import Film

_FRAME = 0.05  # seconds between two frames of the GIF
_TICK = 0.01  # seconds; the unit of time of a GIF


def write_gif(
    film: Film, path: Path, *, seconds: float, width: int = 400, height: int = 300
) -> None:
    """Writes the beginning of a film as a GIF.

    Args:
      film: at least two frames.
      path: path of the file.
      seconds: length of the beginning.
      width: in pixels; the model limits width and height.
      height: in pixels.

    Raises:
      UserError: MuJoCo cannot draw here, or the file cannot be written.
    """
    step = max(1, round(_FRAME / film.seconds))
    frames = np.arange(0, len(film.position), step)
    frames = frames[frames * film.seconds < seconds]
    ends = np.round((frames + step) * film.seconds / _TICK)
    durations = np.diff(ends, prepend=0) * _TICK * 1000
    first, *others = map(Image.fromarray, _draw(film, frames, width, height))
    with writing(path):
        first.save(
            path,
            save_all=True,
            append_images=others,
            duration=durations.astype(int).tolist(),
            loop=0,
        )


def _draw(film: Film, frames: Any, width: int, height: int) -> list[Any]:
    """`[height, width, 3]` uint8 for each of the frames."""
    model = copy.copy(film.model)
    # Planes are infinite in the simulation, so they are drawn as infinite. Their
    # texture repeats every two metres.
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_size[planes, :2] = 0
    model.mat_texrepeat[model.geom_matid[planes & (model.geom_matid >= 0)]] = 0.5
    model.vis.headlight.ambient[:] = 0.4
    model.vis.quality.shadowsize = 1024
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    lights = data.light_xpos.copy()
    gaze, size = films.gaze(film)
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.distance, camera.azimuth, camera.elevation = 4.5 * size, 105, -18
    # Hides the sites, which do not move.
    option.sitegroup[:] = 0
    scene = mujoco.MjvScene(model, maxgeom=10 * model.ngeom)
    scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
    area = mujoco.MjrRect(0, 0, width, height)
    pictures = []
    with _opened(model, width, height) as context:
        for frame in frames:
            data.geom_xpos[:] = film.position[frame]
            data.geom_xmat[:] = film.rotation[frame].reshape(-1, 9)
            data.light_xpos[:] = lights + gaze[frame] - gaze[0]
            camera.lookat[:] = gaze[frame]
            every = mujoco.mjtCatBit.mjCAT_ALL
            mujoco.mjv_updateScene(model, data, option, None, camera, every, scene)
            mujoco.mjr_render(area, scene, context)
            picture = np.empty((height, width, 3), np.uint8)
            mujoco.mjr_readPixels(picture, None, area, context)
            pictures.append(picture[::-1])  # OpenGL begins at the bottom.
    return pictures


@contextlib.contextmanager
def _opened(model: Any, width: int, height: int) -> Iterator[Any]:
    """A context to draw without a window; `MUJOCO_GL` chooses its kind."""
    try:
        if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
            # MuJoCo's default on Linux needs a screen.
            from mujoco.egl import GLContext
        else:
            from mujoco.gl_context import GLContext
        window = GLContext(width, height)
        window.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # Each platform raises other types.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"MuJoCo cannot draw without a window here ({reason}): install EGL, or set "
            "MUJOCO_GL to egl, osmesa or glfw"
        ) from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    try:
        yield context
    finally:
        context.free()
        window.free()
