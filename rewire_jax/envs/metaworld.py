"""Meta-World's manipulation tasks (v3) as a domain whose tasks are data.

The observation has 39 numbers: hand (3), gripper (1), objects (14), the same 18 numbers
of the previous step, and the goal (3). The action has four numbers in [-1, 1]. Three
move the hand by at most a centimetre each; one drives the gripper.
"""

import functools
import importlib
from collections.abc import Sequence

import jax.numpy as jnp

from rewire_jax.core.errors import UserError
from rewire_jax.envs import task_parameters
from rewire_jax.envs.base import Domain, Task, TaskChange

BACKENDS = ("mujoco", "mjx")
REWARDS = ("v1", "v2")
JOINTS = ("x", "y", "z", "gripper")
OBSERVATION_SIZE = 39
EPISODE_LENGTH = 200  # Continual World's; the package's own is 500


def make_domain(backend: str, reward: str, names: tuple[str, ...]) -> Domain:
    """Makes the domain of some tasks; the same arguments give the identical object.

    A `TaskChange` names its task as `extra={"task": name}`. It may change actions by
    joint name (`"x"`, `"y"`, `"z"`, `"gripper"`) and hide observations, nothing else.
    `Task.physics` is the index of the task in `names`.

    Args:
      backend: `"mujoco"`, the package `metaworld` on the host, or `"mjx"`, compiled.
      reward: version of the reward, `"v1"` or `"v2"`.
      names: the tasks, without their version: `"window-close"`.

    Returns:
      The domain.

    Raises:
      UserError: no such backend, reward or task, or the backend is not installed.
    """
    task_parameters.check_names("Meta-World backend", [backend], BACKENDS)
    task_parameters.check_names("Meta-World reward", [reward], REWARDS)
    return _make_domain(backend, reward, tuple(names))


@functools.cache
def _make_domain(backend: str, reward: str, names: tuple[str, ...]) -> Domain:
    # Each backend needs other packages, so this imports only the requested one.
    module = importlib.import_module(f"rewire_jax.envs.metaworld_{backend}")
    environment = module.make_environment(reward, names)
    return Domain(environment, functools.partial(_make_task, names))


def _make_task(names: Sequence[str], change: TaskChange) -> Task:
    if change.gravity != 1 or change.friction != 1 or change.bodies:
        raise UserError("Meta-World tasks change no gravity, friction or bodies.")
    if set(change.extra) != {"task"}:
        raise UserError(
            'A Meta-World task is named by extra={"task": name}, not by'
            f" {dict(change.extra)}."
        )
    name = change.extra["task"]
    task_parameters.check_names("Meta-World task of this domain", [name], names)
    return Task(
        physics=jnp.asarray(names.index(name), jnp.int32),
        action_scale=task_parameters.action_scale(JOINTS, change.actions),
        observation_mask=task_parameters.observation_mask(
            OBSERVATION_SIZE, change.hidden
        ),
    )
