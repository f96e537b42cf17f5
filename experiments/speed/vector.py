"""Our environments for those who are not compiled with them."""

import functools

import jax
import numpy as np
from numpy.typing import NDArray

from rewire_jax.envs.base import Environment, Task
from rewire_jax.training import rollout

Array = NDArray[np.float32]


class Vector:
    """Environments side by side, stepped from the host by one compiled call.

    An episode that ends is followed by the next at once.

    Attributes:
      environment: theirs.
      count: how many.
      observation: `[count, observations]`, the latest.
    """

    def __init__(self, environment: Environment, task: Task, count: int):
        """Resets them."""
        self.environment, self.count = environment, count
        begin = jax.vmap(functools.partial(rollout.begin, environment, task))
        advance = jax.vmap(functools.partial(rollout.advance, environment, task))
        self._advance = jax.jit(advance, donate_argnums=0)
        self._episodes = jax.jit(begin)(jax.random.split(jax.random.key(0), count))
        # A copy: what is donated is gone.
        self.observation = np.array(self._episodes.state.observation)

    def step(self, action: Array) -> rollout.Step:
        """Steps all; the arrays are NumPy's, `[count, ...]`."""
        self._episodes, step = self._advance(self._episodes, action)
        step = jax.tree.map(np.asarray, step)
        self.observation = np.asarray(step.next_obs)
        return step
