"""Meta-World compiled: the package `MTCWorldMJX`, on MuJoCo's Warp for JAX.

Each task has its own MuJoCo model, so the states of the tasks differ in size. Here all
states are vectors of one length. So a task is data, and one program serves all tasks.
It runs only the branch of the current task.
"""

import copy
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from rewire_jax.core.errors import UserError
from rewire_jax.envs import batched_switch, task_parameters
from rewire_jax.envs.base import Environment, State, Task
from rewire_jax.envs.metaworld import EPISODE_LENGTH, JOINTS, OBSERVATION_SIZE

try:
    import warp

    warp.config.quiet = True  # before it compiles and prints messages
    import MTCWorldMJX
    from MTCWorldMJX import mjx_env
    from MTCWorldMJX.envs.sawyer_xyz import SawyerXYZConfig
except ImportError as error:
    raise UserError(
        "Meta-World on MJX-Warp is not installed: `make setup-mjx`, or pip install"
        " 'rewire_jax[cw-mjx]' in an environment without metaworld, whose MuJoCo is"
        " older."
    ) from error

_VERSION = "-v3"
NAMES = tuple(name.removesuffix(_VERSION) for name in MTCWorldMJX.ENV_CLS_MAP)

# Fields of MuJoCo's model that differ between environments, and of its data that differ
# between steps. All others are constant, or computed before they are read. Warp places
# geometry that is fixed to the world only once, so poses are kept too.
_PLACED = ("body_pos", "site_pos")
_MOVING = (
    "qpos",
    "qvel",
    "qacc_warmstart",
    "mocap_pos",
    "mocap_quat",
    "geom_xpos",
    "geom_xmat",
)

# Capacity of each environment. Scripted experts and random actions on the ten tasks of
# Continual World needed at most 42 contacts and 176 constraints.
_CONTACTS = 96
_CONSTRAINTS = 384
# As in the models. The package uses six, for speed.
_ITERATIONS = 50


class Scene(NamedTuple):
    """The part of a simulation that is kept between steps.

    Attributes:
      model: field of MuJoCo's model -> its value.
      data: field of MuJoCo's data -> its value.
      info: values that the reward and the observation need from earlier steps.
    """

    model: dict[str, jax.Array]
    data: dict[str, jax.Array]
    info: dict[str, jax.Array]


_Moved = tuple[Scene, jax.Array, jax.Array, jax.Array]


class Simulator(NamedTuple):
    """The simulation of one task, for a batch of environments.

    Attributes:
      reset: `keys [n] -> Scene, observations [n, 39], rewards [n], successes [n]`.
      step: `(Scene, actions [n, 4]) -> ` the same; leaves of the scene are `[n, ...]`.
      scene: a single `Scene` of zeros.
    """

    reset: Callable[[jax.Array], _Moved]
    step: Callable[[Scene, jax.Array], _Moved]
    scene: Scene


def make_environment(reward: str, names: tuple[str, ...]) -> Environment:
    """The environment of some tasks. Every reset draws a new goal and a new start.

    Args:
      reward: `"v2"`; the package has no other.
      names: of `NAMES`.

    Returns:
      The environment; `State.inner` is a `Scene` in a vector.

    Raises:
      UserError: no such task, or reward `"v1"`.
    """
    if reward != "v2":
        raise UserError(
            f"Meta-World on MJX-Warp has no reward {reward!r}: choose --reward v2 or"
            " --backend mujoco."
        )
    task_parameters.check_names("Meta-World task", names, NAMES)
    simulators = [make_simulator(name) for name in names]
    length = max(len(ravel_pytree(simulator.scene)[0]) for simulator in simulators)

    def pack(moved: _Moved) -> tuple[jax.Array, ...]:
        scene, *rest = moved
        inner = jax.vmap(lambda one: ravel_pytree(one)[0])(scene)
        return jnp.pad(inner, ((0, 0), (0, length - inner.shape[1]))), *rest

    def resetting(simulator: Simulator) -> Callable[..., Any]:
        return lambda keys: pack(simulator.reset(keys))

    def stepping(simulator: Simulator) -> Callable[..., Any]:
        zeros, unravel = ravel_pytree(simulator.scene)

        def step(inner, actions):
            scenes = jax.vmap(unravel)(inner[:, : len(zeros)])
            return pack(simulator.step(scenes, actions))

        return step

    any_reset = batched_switch.switch(
        [resetting(simulator) for simulator in simulators]
    )
    any_step = batched_switch.switch([stepping(simulator) for simulator in simulators])

    def masked(task: Task, moved: tuple[jax.Array, ...]) -> State:
        inner, observation, reward, success = moved
        return State(
            inner=inner,
            observation=observation * task.observation_mask,
            reward=reward,
            terminal=jnp.zeros((), bool),
            success=success,
        )

    def reset(task: Task, key: jax.Array) -> State:
        return masked(task, any_reset(task.physics, key))

    def step(task: Task, state: State, action: jax.Array) -> State:
        action = action * task.action_scale
        return masked(task, any_step(task.physics, state.inner, action))

    return Environment(
        reset=reset,
        step=step,
        observation_size=OBSERVATION_SIZE,
        action_size=len(JOINTS),
        episode_length=EPISODE_LENGTH,
        success=True,
        varied=True,
    )


@functools.cache
def make_simulator(name: str) -> Simulator:
    """The simulation of one task; the same name gives the identical object.

    Args:
      name: of `NAMES`.
    """
    made = MTCWorldMJX.make(
        name + _VERSION,
        config=SawyerXYZConfig(
            partially_observable=False,
            solver_iterations=_ITERATIONS,
            ls_iterations=_ITERATIONS,
            njmax=_CONSTRAINTS,
        ),
    )

    def sized(count: int) -> Any:
        env = copy.copy(made)
        env.config = dataclasses.replace(made.config, naconmax=count * _CONTACTS)
        return env

    def moved(state: mjx_env.State) -> _Moved:
        scene = Scene(
            model={field: getattr(state.model, field) for field in _PLACED},
            data={field: getattr(state.data, field) for field in _MOVING},
            info={name: value for name, value in state.info.items() if name != "rng"},
        )
        return scene, state.obs, state.reward, state.metrics["success"] > 0

    def reset(keys: jax.Array) -> _Moved:
        env = sized(len(keys))
        return jax.vmap(lambda key: moved(env.reset(key)))(keys)

    def step(scenes: Scene, actions: jax.Array) -> _Moved:
        env = sized(len(actions))

        def one(scene: Scene, action: jax.Array) -> _Moved:
            data = mjx_env.make_data(
                env.mj_model,
                env.mjx_model,
                naconmax=env.config.naconmax,
                njmax=env.config.njmax,
            )
            state = mjx_env.State(
                model=env.mjx_model.replace(**scene.model),
                data=data.replace(**scene.data),
                info=scene.info,
                # Not read in a step.
                obs=None,
                reward=None,
                truncated=None,
                terminated=None,
            )
            return moved(env.step(state, action))

        return jax.vmap(one)(scenes, actions)

    scene = jax.eval_shape(lambda key: moved(made.reset(key))[0], jax.random.key(0))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), scene)
    return Simulator(reset, step, zeros)
