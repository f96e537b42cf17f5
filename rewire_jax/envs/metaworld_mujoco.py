"""Meta-World on the host: the package `metaworld`, on C MuJoCo."""

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from rewire_jax.envs import changes
from rewire_jax.envs.base import HostEnvironment
from rewire_jax.envs.metaworld import EPISODE_LENGTH, JOINTS, OBSERVATION_SIZE
from rewire_jax.errors import UserError

try:
    import gymnasium
    import mujoco
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS
except ImportError as error:
    raise UserError(
        "Meta-World on MuJoCo is not installed: pip install 'rewire_jax[cw]'."
    ) from error

_VERSION = "-v3"
# The arrays of a model that are its scene; shapes and textures are large, and fixed.
_SCENE = ("actuator_", "body_", "dof_", "eq_", "geom_", "jnt_", "site_", "tendon_")
NAMES = tuple(name.removesuffix(_VERSION) for name in ALL_V3_ENVIRONMENTS)


def make_environment(reward: str, names: tuple[str, ...]) -> HostEnvironment:
    """The environment of some tasks.

    Args:
      reward: `"v1"` or `"v2"`.
      names: of `NAMES`.

    Returns:
      The environment, which makes a `Simulator`.

    Raises:
      UserError: no such task.
    """
    changes.check_names("Meta-World task", names, NAMES)
    return HostEnvironment(
        make=functools.partial(Simulator, names, reward),
        observation_size=OBSERVATION_SIZE,
        action_size=len(JOINTS),
        episode_length=EPISODE_LENGTH,
        success=True,
    )


class Simulator(gymnasium.Env):
    """Episodes of several tasks, each determined by its seed and its actions.

    Goal and start are drawn anew at every reset. Episodes have no end; the package
    takes at most 500 steps. A task's model is built at its first episode, and kept.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(JOINTS),))

    def __init__(self, names: tuple[str, ...], reward: str) -> None:
        self._names = names
        self._reward = reward
        self._scenes: dict[int, _Scene] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode.

        Args:
          seed: what start and goal are drawn from.
          options: `{"task": index}`, into the names.

        Returns:
          `[39]` float32, the observation, and an empty dictionary.
        """
        assert seed is not None
        assert options is not None
        task = int(options["task"])
        if task not in self._scenes:
            self._scenes[task] = _Scene(self._names[task], self._reward)
        self._simulation = self._scenes[task].renewed()
        self._simulation.seed(int(seed))
        observation, _ = self._simulation.reset()
        return observation.astype(np.float32), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes a step.

        Args:
          action: `[4]` in [-1, 1].

        Returns:
          `[39]` float32, the observation; the reward; whether the task itself ended
          and whether time did, both never; whether the task is solved, as
          `{"success": bool}`.
        """
        observation, reward, _, _, info = self._simulation.step(action)
        success = {"success": bool(info["success"])}
        return observation.astype(np.float32), float(reward), False, False, success


class _Scene:
    """One of the package's environments that can be had as new, time and again.

    Its `reset` leaves a lot of what was played before: positions in the model that it
    overwrites, the data's solver state and derived positions, attributes. All of it is
    put back, so that every reset is the first one after construction.
    """

    def __init__(self, name: str, reward: str) -> None:
        env = ALL_V3_ENVIRONMENTS[name + _VERSION](reward_function_version=reward)
        env._set_task_called = True  # it is the seed that sets the task
        env._freeze_rand_vec = False
        env.seeded_rand_vec = True
        env._partially_observable = False
        del env.sawyer_observation_space  # cached, with the goal bounded to zeros
        self._env = env
        self._attributes = _own(vars(env))
        self._model = [
            (array, array.copy())
            for field in dir(env.model)
            if field.startswith(_SCENE)
            and isinstance(array := getattr(env.model, field), np.ndarray)
        ]

    def renewed(self) -> Any:
        """The environment as it was made; it has still to be seeded and reset."""
        env = self._env
        for array, made in self._model:
            array[...] = made
        mujoco.mj_resetData(env.model, env.data)
        mujoco.mj_forward(env.model, env.data)
        env.__dict__ = _own(self._attributes)
        return env


def _own(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """A copy whose arrays may be written to; views of the simulation stay views."""
    return {
        name: value.copy()
        if isinstance(value, np.ndarray) and value.flags.owndata
        else value
        for name, value in attributes.items()
    }
