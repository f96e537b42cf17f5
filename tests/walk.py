"""The same small task twice: compiled, and as a simulator on the host.

A walker in the plane is moved by a tenth of its actions from the origin towards the
task's goal, and has succeeded within 0.3 of it. It ends beyond 0.6 on the second axis.
"""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.envs.base import Environment, HostEnvironment, State, Task
from rewire_jax.envs.scenarios import Scenario, ScenarioTask

GOALS = ((0.5, 0.0), (-0.4, 0.4))
LENGTH = 12


class Walker(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-2.0, 2.0, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def __init__(self, spread: float, noise: float) -> None:
        self.spread, self.noise = np.float32(spread), noise

    def reset(self, *, seed=None, options=None):
        self.goal = np.float32(GOALS[options["task"]])
        start = np.random.default_rng(seed).uniform(-1, 1, 2).astype(np.float32)
        self.position = self.spread * start
        return self.position, {}

    def step(self, action):
        assert action.dtype == np.float32
        self.position = self.position + np.float32(0.1) * action
        if self.noise:  # what a simulator must not have
            self.position += np.float32(np.random.default_rng().normal(0, self.noise))
        gap = self.position - self.goal
        distance = gap[0] * gap[0] + gap[1] * gap[1]
        return (
            self.position,
            -float(distance),
            bool(self.position[1] > 0.6),
            False,
            {"success": bool(distance < 0.09)},
        )


def walker(spread: float = 0.0, noise: float = 0.0) -> HostEnvironment:
    """On the host; starts lie within `spread` of the origin."""
    return HostEnvironment(
        make=functools.partial(Walker, spread, noise),
        observation_size=2,
        action_size=2,
        episode_length=LENGTH,
        success=True,
    )


def _reset(task: Task, key: jax.Array) -> State:
    false = jnp.zeros((), bool)
    return State((), jnp.zeros(2), jnp.zeros(()), false, false)


def _step(task: Task, state: State, action: jax.Array) -> State:
    position = state.observation / task.observation_mask
    position = position + 0.1 * (action * task.action_scale)
    gap = position - jnp.asarray(GOALS)[task.physics]
    distance = gap[0] * gap[0] + gap[1] * gap[1]
    seen = position * task.observation_mask
    return State((), seen, -distance, position[1] > 0.6, distance < 0.09)


COMPILED = Environment(_reset, _step, 2, 2, LENGTH, success=True)
TASKS = tuple(
    Task(jnp.int32(k), jnp.array([1.0, -0.5]), jnp.array([1.0, 0.5]))
    for k in range(len(GOALS))
)


def scenario(environment: Environment | HostEnvironment) -> Scenario:
    return Scenario(
        name="walk",
        domain="walk",
        backend="host",
        reward="v2",
        environment=environment,
        tasks=tuple(ScenarioTask(f"goal-{k}", k, t) for k, t in enumerate(TASKS)),
        distinct=len(TASKS),
        interactions=1_000,
        preset="walk",
    )
