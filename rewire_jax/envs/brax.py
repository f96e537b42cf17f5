"""Brax's HalfCheetah, Ant and Humanoid as domains whose tasks are data.

The physics of a task is a whole brax `System`. All systems of a domain have the same
structure and static fields. So one trace serves them all, and they can be stacked and
vmapped.
"""

import copy
import functools
import warnings
from collections.abc import Sequence
from typing import Any

import brax.envs
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax import math
from brax.base import System, Transform
from brax.envs.base import PipelineEnv
from brax.envs.base import State as BraxState

from rewire_jax.core import kept_programs
from rewire_jax.envs import task_parameters
from rewire_jax.envs.base import Domain, Environment, State, Task, TaskChange
from rewire_jax.envs.geom_trajectory import Film

NAMES = ("halfcheetah", "ant", "humanoid")
BACKENDS = ("positional", "spring", "generalized", "mjx")
EPISODE_LENGTH = 1000

# The geoms of a body that its factor resizes. Brax v1 resized the first collider of a
# body on HalfCheetah and the last on Humanoid (the last of a shin is the foot). An Ant
# leg had one collider in v1. Here it is a capsule with a foot, and only the foot
# touches the ground.
_RESIZED = {
    "halfcheetah": slice(0, 1),
    "ant": slice(None),
    "humanoid": slice(-1, None),
}


def make_domain(name: str, backend: str = "positional") -> Domain:
    """Makes a domain; the same arguments give the identical object.

    Args:
      name: `"halfcheetah"`, `"ant"` or `"humanoid"`.
      backend: `"positional"`, `"spring"`, `"generalized"` or `"mjx"`.

    Returns:
      The domain. Body names are MuJoCo's; Ant's unnamed lower legs are called
      `lower_leg_1` to `lower_leg_4` after the ankle they hang on. Bodies
      without a joint are part of their parent (Humanoid's feet: the shins).

    Raises:
      UserError: no such name or backend.
    """
    task_parameters.check_names("Brax domain", [name], NAMES)
    task_parameters.check_names("Brax backend", [backend], BACKENDS)
    return _make_domain(name, backend)


@functools.cache
def _make_domain(name: str, backend: str) -> Domain:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Brax System", UserWarning)
        env = brax.envs.get_environment(name, backend=backend)
    system = _normalize(env.sys, backend)
    environment = _make_environment(env)
    kept_programs.give_name(f"{name} {backend}", environment.reset, environment.step)
    bodies = _body_ids(system.mj_model)
    joints = [
        system.mj_model.joint(joint).name
        for joint in system.mj_model.actuator_trnid[:, 0]
    ]

    return task_parameters.physical_domain(
        environment,
        joints,
        list(bodies),
        lambda change: _change_system(system, change, bodies, _RESIZED[name]),
    )


def _make_environment(env: PipelineEnv) -> Environment:
    def with_physics(task: Task) -> PipelineEnv:
        changed = copy.copy(env)
        changed.sys = task.physics
        return changed

    def reset(task: Task, key: jax.Array) -> State:
        state = with_physics(task).reset(key)
        return State(
            inner=state.pipeline_state,
            observation=state.obs * task.observation_mask,
            reward=jnp.zeros_like(state.reward),
            terminal=jnp.zeros((), bool),
        )

    def step(task: Task, state: State, action: jax.Array) -> State:
        # Of its own state, brax's step reads only the pipeline state.
        before = BraxState(
            pipeline_state=state.inner,
            obs=state.observation,
            reward=state.reward,
            done=jnp.zeros_like(state.reward),
        )
        # Scaled first, so that the control cost is charged on what acts.
        after = with_physics(task).step(before, action * task.action_scale)
        return State(
            inner=after.pipeline_state,
            observation=after.obs * task.observation_mask,
            reward=after.reward,
            terminal=after.done.astype(bool),
        )

    observation = jax.eval_shape(lambda key: env.reset(key).obs, jax.random.key(0))
    # Tracing takes seconds. With jit, all functions that call these share one trace.
    return Environment(
        reset=jax.jit(reset),
        step=jax.jit(step),
        observation_size=observation.shape[0],
        action_size=env.action_size,
        episode_length=EPISODE_LENGTH,
        film=functools.partial(_film, env.dt),
    )


def _film(seconds: float, task: Task, inners: Sequence[Any]) -> Film:
    """A film of pipeline states; the geometries have the sizes of the task."""
    system = task.physics
    model = copy.copy(system.mj_model)
    model.geom_size[:] = system.geom_size
    shape = Transform(pos=system.geom_pos, rot=system.geom_quat)
    link = system.geom_bodyid - 1  # -1 is the world, which comes last.

    def place(x: Transform) -> tuple[jax.Array, jax.Array]:
        bodies = x.concatenate(Transform.zero((1,)))
        geoms = bodies.take(link).vmap().do(shape)
        return geoms.pos, jax.vmap(math.quat_to_3x3)(geoms.rot)

    x = jax.tree.map(lambda *leaves: np.stack(leaves), *[inner.x for inner in inners])
    position, rotation = jax.jit(jax.vmap(place))(x)
    return Film(model, seconds, np.asarray(position), np.asarray(rotation))


def _normalize(system: System, backend: str) -> System:
    """Makes every leaf an array on the host, and every mass the one that acts."""
    changed: dict[str, Any] = {"tex_data": np.zeros(0, np.uint8)}  # half a megabyte
    if backend in ("positional", "spring"):
        # These backends first raise each mass to the power 1 - spring_mass_scale (0 on
        # Ant). That would weaken a body factor or undo it.
        mass = system.link.inertia.mass ** (1 - system.spring_mass_scale)
        changed |= {"link.inertia.mass": mass, "spring_mass_scale": 0.0}
    # On a device, each of the changes below would be compiled.
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, jnp.result_type(leaf)),
        system.tree_replace(changed),
    )


def _body_ids(model: mujoco.MjModel) -> dict[str, int]:
    """Every moving body's MuJoCo index by its name."""
    ids = {}
    for body in range(1, model.nbody):
        joint = model.joint(model.body_jntadr[body]).name
        name = model.body(body).name or joint.replace("ankle", "lower_leg")
        ids[name] = body
    return ids


def _change_system(
    system: System, change: TaskChange, bodies: dict[str, int], resized: slice
) -> System:
    """The system with its gravity, friction, masses and radii changed.

    Args:
      system: the unchanged domain's.
      change: valid for this domain.
      bodies: body name -> MuJoCo index.
      resized: which of a changed body's geoms get another radius.

    Returns:
      A system of the same structure, shapes and dtypes. Inertias stay.
    """
    model = copy.copy(system.mj_model)
    mass = np.ones(model.nbody)
    radius = np.ones(model.ngeom)
    for name, factor in change.bodies.items():
        mass[bodies[name]] = factor
        radius[np.flatnonzero(model.geom_bodyid == bodies[name])[resized]] = factor
    # MuJoCo derives the softness of contacts and limits from the masses.
    model.body_mass[:] *= mass
    mujoco.mj_setConst(model, mujoco.MjData(model))

    size = system.geom_size
    scale = np.ones_like(size)
    scale[:, 0] = radius
    new = {
        "gravity": system.gravity * change.gravity,
        "opt.gravity": system.opt.gravity * change.gravity,
        # All three columns, because v1 had one number. If two geoms touch, the rougher
        # one counts; so the friction of all geoms changes, the floor's too.
        "geom_friction": system.geom_friction * change.friction,
        # Only the radius changes; a capsule keeps the distance between its ends. The
        # bound of a capsule or a sphere grows with its radius.
        "geom_size": size * scale,
        "geom_rbound": system.geom_rbound + size[:, 0] * (radius - 1),
        "link.inertia.mass": system.link.inertia.mass * mass[1:],
        "body_mass": model.body_mass,
        "body_subtreemass": model.body_subtreemass,
        "body_invweight0": model.body_invweight0,
        "dof_invweight0": model.dof_invweight0,
        "link.invweight": model.body_invweight0[1:, 0],
        "dof.invweight": model.dof_invweight0,
        "stat.meaninertia": model.stat.meaninertia,
    }
    # Copies, because MuJoCo's arrays are views of a model that is freed here.
    changed = system.tree_replace({k: np.array(v) for k, v in new.items()})
    return jax.tree.map(
        lambda x, old: jnp.asarray(x.astype(old.dtype)), changed, system
    )
