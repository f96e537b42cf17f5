"""Meta-World on the host: the package `metaworld`, on C MuJoCo."""

import functools
from typing import Any

import numpy as np

from rewire_jax.core.errors import UserError
from rewire_jax.envs import task_parameters
from rewire_jax.envs.base import HostEnvironment
from rewire_jax.envs.metaworld import EPISODE_LENGTH, JOINTS, OBSERVATION_SIZE

try:
    import gymnasium
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS
    from metaworld.sawyer_xyz_env import SawyerXYZEnv
except ImportError as error:
    raise UserError(
        "Meta-World on MuJoCo is not installed: pip install 'rewire_jax[cw]'."
    ) from error

_VERSION = "-v3"
NAMES = tuple(name.removesuffix(_VERSION) for name in ALL_V3_ENVIRONMENTS)


def make_environment(reward: str, names: tuple[str, ...]) -> HostEnvironment:
    """The environment of some tasks.

    Args:
      reward: `"v1"` or `"v2"`.
      names: some of `NAMES`.

    Returns:
      The environment, which makes a `Simulator`.

    Raises:
      UserError: no such task.
    """
    task_parameters.check_names("Meta-World task", names, NAMES)
    return HostEnvironment(
        make=functools.partial(Simulator, names, reward),
        observation_size=OBSERVATION_SIZE,
        action_size=len(JOINTS),
        episode_length=EPISODE_LENGTH,
        success=True,
    )


class Simulator(gymnasium.Env):
    """Episodes of several tasks, each determined by its seed and its actions.

    Every reset draws a new goal and a new start. Episodes do not end, but the package
    allows at most 500 steps. A task's model is built at its first episode and kept.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(JOINTS),))

    def __init__(self, names: tuple[str, ...], reward: str) -> None:
        self._names = names
        self._reward = reward
        self._simulations: dict[int, SawyerXYZEnv] = {}

    @property
    def simulation(self) -> SawyerXYZEnv:
        """The package's environment of the current episode."""
        return self._current

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode.

        Args:
          seed: determines start and goal.
          options: `{"task": index}`, an index into the names.

        Returns:
          `[39]` float32, the observation, and an empty dictionary.
        """
        assert seed is not None
        assert options is not None
        task = int(options["task"])
        if task not in self._simulations:
            self._simulations[task] = _simulation(self._names[task], self._reward)
        self._current = self._simulations[task]
        # The package's reset sets the task up twice, the second time after MuJoCo's own
        # reset. So after seeding, nothing of the previous episode has an effect.
        self._current.seed(int(seed))
        observation, _ = self._current.reset()
        return observation.astype(np.float32), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes a step.

        Args:
          action: `[4]` in [-1, 1].

        Returns:
          `[39]` float32, the observation; the reward; terminated and truncated, both
          always False; and `{"success": bool}`, whether the task is solved.
        """
        observation, reward, _, _, info = self._current.step(action)
        success = {"success": bool(info["success"])}
        return observation.astype(np.float32), float(reward), False, False, success


def _simulation(name: str, reward: str) -> SawyerXYZEnv:
    """An environment of the package that draws start and goal from its seed."""
    env = ALL_V3_ENVIRONMENTS[name + _VERSION](reward_function_version=reward)
    env._set_task_called = True
    env._freeze_rand_vec = False
    env.seeded_rand_vec = True
    # The goal is observed. The package clips observations to a cached space, which
    # would clip the goal to zeros.
    env._partially_observable = False
    del env.sawyer_observation_space
    return env
