"""A domain of one's own: a point that is pushed along a corridor."""

import jax
import jax.numpy as jnp

from rewire_jax import ScenarioSpec, TaskChange, register_domain, register_scenario
from rewire_jax.envs import Domain, Environment, State, Task

STRIDE = 0.1


def reset(task: Task, key: jax.Array) -> State:
    """Starts anywhere; the goal is in `task`, and is not observed."""
    place = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
    return State(
        inner=place,
        observation=place * task.observation_mask,
        reward=jnp.zeros(()),
        terminal=jnp.zeros((), bool),
    )


def step(task: Task, state: State, action: jax.Array) -> State:
    """Moves by the action; the reward is minus the distance to the goal."""
    moved = state.inner + STRIDE * action * task.action_scale
    place = jnp.clip(moved, -1.0, 1.0)
    return State(
        inner=place,
        observation=place * task.observation_mask,
        reward=-jnp.abs(place - task.physics)[0],
        terminal=jnp.zeros((), bool),
    )


def make_task(change: TaskChange) -> Task:
    """A task as arrays, of the same shapes for every task."""
    return Task(
        physics=jnp.asarray(change.extra["goal"], jnp.float32),
        action_scale=jnp.full(1, change.actions.get("push", 1.0)),
        observation_mask=jnp.ones(1),
    )


# Made once: runs that share an environment share what is compiled.
CORRIDOR = Domain(
    Environment(reset, step, observation_size=1, action_size=1, episode_length=20),
    make_task,
)
register_domain("corridor", CORRIDOR)

register_scenario(
    ScenarioSpec(
        name="corridor/ends",
        domain="corridor",
        changes=(
            TaskChange("right", extra={"goal": 0.8}),
            TaskChange("left", extra={"goal": -0.8}),
            TaskChange("reversed", extra={"goal": 0.8}, actions={"push": -1.0}),
        ),
        repeats=1,
        interactions=20_000,
    )
)
