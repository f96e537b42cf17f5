"""Brax's HalfCheetah, Ant and Humanoid on `brax.v1`, the engine of the paper's runs.

A task change alters the domain's config, as in the authors' code; the config makes a
`System`. The physics of a task holds only what differs between systems. So one trace
serves all tasks of a domain.
"""

import copy
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from rewire_jax.core import kept_programs
from rewire_jax.envs import brax_v1_shim, task_parameters
from rewire_jax.envs.base import Domain, Environment, State, Task, TaskChange
from rewire_jax.envs.geom_trajectory import Film

EPISODE_LENGTH = 1000

# By domain: module and class of the environment, and the collider of a body that its
# factor resizes.
_DOMAINS = {
    "halfcheetah": ("envs.half_cheetah", "Halfcheetah", 0),
    "ant": ("envs.ant", "Ant", 0),
    "humanoid": ("envs.humanoid", "Humanoid", -1),
}


class Physics(NamedTuple):
    """The parts of a `brax.v1` system that a task can change.

    Attributes:
      leaves: the system's arrays that gravity, friction, masses or radii change.
      radius: `[colliders]` in metres, body by body; 0 for a plane. A reset uses it to
        put the bodies on the ground.
    """

    leaves: tuple[jax.Array, ...]
    radius: jax.Array


@functools.cache
def make_domain(name: str) -> Domain:
    """Makes a domain; the same name gives the identical object.

    Args:
      name: `"halfcheetah"`, `"ant"` or `"humanoid"`.

    Returns:
      The domain. Bodies have the same names as on the other backends. Joints have v1's
      names: if a joint has several axes, one name stands for all its actions.

    Raises:
      UserError: the installed brax has no `brax.v1`.
    """
    systems = Systems(name)
    environment = _make_environment(systems)
    kept_programs.give_name(f"{name} v1", environment.reset, environment.step)
    return task_parameters.physical_domain(
        environment,
        _joint_of_each_action(systems.config),
        list(systems.bodies),
        systems.physics,
    )


class Systems:
    """All systems of a domain: the parts they share, and the parts that tasks change.

    An array that no task changes is a constant of the compiled program.

    Attributes:
      env: the environment of `brax.v1`.
      config: config of the unchanged domain.
      bodies: index of every moving body by its name.
    """

    def __init__(self, name: str) -> None:
        module, cls, self._resized = _DOMAINS[name]
        self._make = getattr(brax_v1_shim.module(module), cls)
        self.env = self._make()
        self.config = self.env.sys.config
        self.bodies = _body_indices(self.config)
        everything = TaskChange("all", 2.0, 2.0, dict.fromkeys(self.bodies, 2.0))
        self._leaves, self._structure = jax.tree.flatten(_whole(self.env.sys))
        others = jax.tree.leaves(_whole(self._changed(everything)))
        self._varied = [
            index
            for index, pair in enumerate(zip(self._leaves, others, strict=True))
            if not np.array_equal(*pair)
        ]

    def _changed(self, change: TaskChange) -> Any:
        """The system that a valid task change makes."""

        def alter(config: Any) -> Any:
            config.gravity.z *= change.gravity
            # By now every collider has the config's friction.
            for collider in (c for body in config.bodies for c in body.colliders):
                collider.material.friction *= change.friction
            for name, factor in change.bodies.items():
                body = config.bodies[self.bodies[name]]
                body.mass *= factor
                body.colliders[self._resized].capsule.radius *= factor
            return config

        return self._make(post_process_fn=alter).sys

    def physics(self, change: TaskChange) -> Physics:
        """The parts of the changed system that differ from others."""
        system = self._changed(change)
        leaves = jax.tree.leaves(_whole(system))
        radius = [
            collider.capsule.radius
            for body in system.config.bodies
            for collider in body.colliders
        ]
        return Physics(
            tuple(jnp.asarray(leaves[i], jnp.float32) for i in self._varied),
            jnp.asarray(radius, jnp.float32),
        )

    def system(self, physics: Physics) -> Any:
        """The whole of a changed system."""
        leaves = list(self._leaves)
        for index, leaf in zip(self._varied, physics.leaves, strict=True):
            leaves[index] = leaf
        system, hidden = jax.tree.unflatten(self._structure, leaves)
        for collider, (cull, threshold) in zip(system.colliders, hidden, strict=True):
            collider.cull, collider.velocity_threshold = cull, threshold
        radius = iter(physics.radius)
        bodies = [
            {"colliders": [{"capsule": {"radius": next(radius)}} for _ in b.colliders]}
            for b in self.config.bodies
        ]
        customize = brax_v1_shim.module("experimental.tracing.customize")
        system.config = customize.TracedConfig(self.config, {"bodies": bodies})
        return system


def _whole(system: Any) -> tuple[Any, Any]:
    """A system, and what tasks change of its colliders, which are no leaves."""
    return system, [(c.cull, c.velocity_threshold) for c in system.colliders]


def _make_environment(systems: Systems) -> Environment:
    env = systems.env

    def with_physics(task: Task) -> Any:
        changed = copy.copy(env)
        changed.sys = systems.system(task.physics)
        return changed

    def reset(task: Task, key: jax.Array) -> State:
        state = with_physics(task).reset(key)
        return State(
            inner=state.qp,
            observation=state.obs * task.observation_mask,
            reward=jnp.zeros(()),
            terminal=jnp.zeros((), bool),
        )

    def step(task: Task, state: State, action: jax.Array) -> State:
        # Of its own state, the environment's step reads only the bodies.
        none = jnp.zeros(())
        before = make_state(state.inner, state.observation, none, none)
        # Scaled first, so that the control cost is charged on what acts.
        after = with_physics(task).step(before, action * task.action_scale)
        return State(
            inner=after.qp,
            observation=after.obs * task.observation_mask,
            reward=after.reward,
            terminal=jnp.asarray(after.done, bool),
        )

    make_state = brax_v1_shim.module("envs.env").State
    sizes = jax.eval_shape(env.reset, jax.random.key(0))
    # Tracing takes seconds. With jit, all functions that call these share one trace.
    return Environment(
        reset=jax.jit(reset),
        step=jax.jit(step),
        observation_size=sizes.obs.shape[0],
        action_size=env.action_size,
        episode_length=EPISODE_LENGTH,
        film=functools.partial(_film, systems.config),
    )


def _body_indices(config: Any) -> dict[str, int]:
    """Every moving body's index by the name that it has on the other backends."""
    above = {joint.child: joint.name for joint in config.joints}
    names = {}
    for index, body in enumerate(config.bodies):
        name = body.name
        if name.startswith("$ Body"):  # Ant's lower legs
            name = above[name].replace("ankle", "lower_leg")
        elif name.startswith("Aux"):
            name = above[name].replace("hip", "aux")
        if not body.frozen.all:
            names[name.removeprefix("$ ").lower()] = index
    return names


def _joint_of_each_action(config: Any) -> list[str]:
    """Names of the joints that the actions drive; an action is one axis of a joint."""
    axes = {
        joint.name: sum(bool(limit.min or limit.max) for limit in joint.angle_limit)
        for joint in config.joints
    }
    return [a.joint for a in config.actuators for _ in range(axes[a.joint])]


def _film(config: Any, task: Task, inners: Sequence[Any]) -> Film:
    """A film of the bodies' `QP`; the colliders have the sizes of the task."""
    model = _model(config, np.asarray(task.physics.radius, float))
    owner, offset, turn = [], [], []
    for index, body in enumerate(config.bodies):
        for collider in body.colliders:
            at, angles = collider.position, collider.rotation
            owner.append(index)
            offset.append([at.x, at.y, at.z])
            turn.append([angles.x, angles.y, angles.z])
    bodies = jax.tree.map(lambda *leaves: np.stack(leaves), *inners)
    position, rotation = [], []
    # v1's Euler angles are intrinsic, x first.
    own = Rotation.from_euler("XYZ", turn, degrees=True)
    for place, quaternion in zip(bodies.pos, bodies.rot, strict=True):
        whole = Rotation.from_quat(quaternion[owner], scalar_first=True)
        position.append(place[owner] + whole.apply(offset))
        rotation.append((whole * own).as_matrix())
    return Film(model, config.dt, np.array(position), np.array(rotation))


def _model(config: Any, radii: Any) -> mujoco.MjModel:
    """A MuJoCo model of the colliders in their order, for rendering only."""
    spec, kinds, radius = mujoco.MjSpec(), mujoco.mjtGeom, iter(radii)
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.25, 0.3, 0.35],
        rgb2=[0.35, 0.4, 0.45],
        width=64,
        height=64,
    )
    floor = spec.add_material(name="floor")
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0, 0, -1])
    for body in config.bodies:
        for collider in body.colliders:
            # One body for each keeps the order: geometries of the world come first.
            of = spec.worldbody.add_body()
            r, half = next(radius), collider.capsule.length / 2
            if collider.HasField("plane"):
                of.add_geom(type=kinds.mjGEOM_PLANE, size=[40, 40, 1], material="floor")
                continue
            of.add_freejoint()
            # The length of a capsule includes its round ends; in a ball they meet.
            ball = half <= r
            of.add_geom(
                type=kinds.mjGEOM_SPHERE if ball else kinds.mjGEOM_CAPSULE,
                size=[r, 0 if ball else half - r, 0],
                rgba=[0.8, 0.6, 0.4, 1],
            )
    return spec.compile()
