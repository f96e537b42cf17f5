"""Several simulators on the host; each has its own process if there are cores."""

import functools
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.errors import UserError
from rewire_jax.envs.base import HostEnvironment, Task

Array = NDArray[Any]


class StepResult(NamedTuple):
    """The result of a step in each lane.

    Attributes:
      observation: `[lanes, observations]` float32.
      reward: `[lanes]` float32.
      terminal: `[lanes]` bool, ended by the task.
      success: `[lanes]` bool; False if the environment does not report it.
    """

    observation: Array
    reward: Array
    terminal: Array
    success: Array


class VectorEnv:
    """Simulators that are reset and stepped together.

    They hold no state that a run must save: seeds and actions reproduce it by resetting
    and stepping.

    Attributes:
      task: index of the current task, -1 before the first reset.
      seeds: `[lanes]` int64, of the running episodes.
      steps: `[lanes]` int, of the running episodes.
      observation: `[lanes, observations]`, the latest.
    """

    def __init__(self, environment: HostEnvironment, count: int):
        """Makes the simulators, each in a process unless this one is as fast."""
        # gymnasium is installed only with such an environment.
        from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

        makers = [environment.make] * count
        mode, cores = AutoresetMode.DISABLED, _cores()
        if min(count, cores) == 1:
            self._vector: Any = SyncVectorEnv(makers, autoreset_mode=mode)
        else:
            with _deaf_to_interrupts():
                # JAX has threads, and a forked process would lose them.
                self._vector = AsyncVectorEnv(
                    makers, context="spawn", autoreset_mode=mode, max_concurrency=cores
                )
        self.task = -1
        self.seeds = np.zeros(count, np.int64)
        self.steps = np.zeros(count, np.int64)
        self.observation = np.zeros((count, environment.observation_size), np.float32)

    def reset(
        self, task: int, seeds: Sequence[int] | Array, where: Array | None = None
    ) -> Array:
        """Begins episodes.

        Args:
          task: its index, the same in all lanes.
          seeds: `[lanes]` int.
          where: `[lanes]` bool, the lanes that begin an episode; all if None.

        Returns:
          `[lanes, observations]` float32, the latest of each lane.
        """
        where = np.ones(len(self.seeds), bool) if where is None else where
        options = {"task": task, "reset_mask": where}
        given = [int(seed) for seed in seeds]
        with _whole():
            self.observation, _ = self._vector.reset(seed=given, options=options)
        self.task = task
        self.seeds = np.where(where, np.asarray(seeds), self.seeds)
        self.steps = np.where(where, 0, self.steps)
        return self.observation

    def step(self, actions: Array) -> StepResult:
        """Steps all lanes; `actions` is `[lanes, actions]` float32 in [-1, 1]."""
        with _whole():
            observation, reward, terminal, _, info = self._vector.step(actions)
        self.observation = observation
        self.steps = self.steps + 1
        success = info.get("success", np.zeros(len(self.seeds), bool))
        return StepResult(
            observation, reward.astype(np.float32), terminal, success.astype(bool)
        )


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Processes that start here ignore Ctrl-C; the main process ends them.

    Raises:
      UserError: they ended while they started.
    """
    # Started inside the block, the tracker would unblock interrupts again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    except (EOFError, ConnectionError) as error:
        raise UserError(
            "the processes of the simulators ended while they started: they import the "
            "main script, so it must train under `if __name__ == '__main__':`"
        ) from error
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _whole() -> Iterator[None]:
    """Drops the simulators if an exception interrupts a call to them."""
    try:
        yield
    except BaseException:
        open_lanes.cache_clear()
        raise


def _cores() -> int:
    """Number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        return os.cpu_count() or 1


def draw_seed(*words: int) -> int:
    """A seed that these numbers determine."""
    return int(np.random.SeedSequence(words).generate_state(1)[0])


def shown(observation: Array, task: Task, shape: tuple[int, ...]) -> Array:
    """The masked observation for the policy, `[*shape, observations]`."""
    return observation.reshape(*shape, -1) * np.asarray(task.observation_mask)


@functools.lru_cache(maxsize=1)
def open_lanes(environment: HostEnvironment, count: int) -> VectorEnv:
    """Simulators in `count` lanes. The last ones are reused: starting takes seconds."""
    return VectorEnv(environment, count)
