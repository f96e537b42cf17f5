"""A film as a web page in one file, which needs no network."""

import html
import json
import re
from pathlib import Path
from string import Template
from typing import Any

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.viewer import scene_to_html

from rewire_jax.envs import geom_trajectory as films
from rewire_jax.envs.geom_trajectory import Film

# The browser itself blocks everything that is not in the file.
_POLICY = (
    '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src data:\">"
)
_PLAYER = Path(__file__).with_name("player.html")
# First position of the camera, in units of the size of what it looks at.
_CAMERA = np.array([1.2, -4.0, 1.4])


def to_html(film: Film, title: str, caption: str) -> str:
    """The page: trimesh's viewer, which includes three.js, and a player.

    Args:
      film: at least two frames.
      title: plain text.
      caption: plain text.
    """
    player = Template(_PLAYER.read_text(encoding="utf-8")).substitute(
        title=html.escape(title),
        caption=html.escape(caption),
        film=json.dumps(to_json(film), separators=(",", ":")),
    )
    page = scene_to_html(_scene(film))
    for at, put in (
        ("<head>", f"<head>{_POLICY}"),
        (r"<title>.*?</title>", f"<title>{html.escape(title)}</title>"),
        ("</body>", f"{player}</body>"),
    ):
        before, after = re.split(at, page)
        page = before + put + after
    return page


def to_json(film: Film) -> dict[str, Any]:
    """The motion, as the player reads it.

    Returns:
      names `[moving]` of nodes in the scene, position `[frames, moving, 3]`, rotation
      `[frames, moving, 4]` (x, y, z, w), gaze `[frames, 3]`, camera `[3]` relative to
      the gaze, floor (its height), size, and seconds between two frames.
    """
    moving = films.movable(film)
    rotation = Rotation.from_matrix(film.rotation[:, moving].reshape(-1, 3, 3))
    gaze, size = films.gaze(film)
    planes = film.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    heights = film.position[0, planes, 2]
    return {
        "names": [_name(geom) for geom in moving],
        "position": film.position[:, moving].round(4).tolist(),
        "rotation": rotation.as_quat()
        .reshape(*film.rotation.shape[:1], len(moving), 4)
        .round(4)
        .tolist(),
        "gaze": gaze.round(4).tolist(),
        "camera": (_CAMERA * size).round(4).tolist(),
        "floor": float(heights.min()) if len(heights) else 0.0,
        "size": round(size, 4),
        "seconds": film.seconds,
    }


def _name(geom: int) -> str:
    return f"geom{geom}"


def _scene(film: Film) -> trimesh.Scene:
    """The first frame, a node for each geometry."""
    # Without this name, the camera gets a random one, and the player could not find it.
    camera = trimesh.scene.Camera(name="camera", fov=(40, 40))
    scene = trimesh.Scene(camera=camera, camera_transform=np.eye(4))
    for geom in films.solids(film):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = film.rotation[0, geom], film.position[0, geom]
        mesh = _mesh(film.model, geom)
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(
                baseColorFactor=films.colour(film, geom),
                metallicFactor=0.0,
                roughnessFactor=0.7,
            )
        )
        name = _name(geom)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=pose)
    return scene


def _mesh(model: Any, geom: int) -> trimesh.Trimesh:
    """The surface of a geometry, in its own frame."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(2 * size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(size[0], 2 * size[1])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        which = model.mesh(model.geom_dataid[geom])
        first, count = which.vertadr[0], which.vertnum[0]
        begin, faces = which.faceadr[0], which.facenum[0]
        return trimesh.Trimesh(
            model.mesh_vert[first : first + count],
            model.mesh_face[begin : begin + faces],
            process=False,
        )
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(2 * size[1], size[0], count=(16, 24))
    else:  # A sphere has one radius, an ellipsoid three.
        mesh = trimesh.creation.uv_sphere(count=(16, 24))
        sphere = kind == mujoco.mjtGeom.mjGEOM_SPHERE
        mesh.apply_scale(size[[0, 0, 0]] if sphere else size)
    # Once computed, normals are part of the page. They make round things look round.
    _ = mesh.vertex_normals
    return mesh
