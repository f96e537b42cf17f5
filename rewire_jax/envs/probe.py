"""Tiny environments in pure JAX whose optimal values are known, for tests."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core import kept_programs
from rewire_jax.core.errors import UserError
from rewire_jax.envs import task_parameters
from rewire_jax.envs.base import Domain, Environment, State, Task, TaskChange

REACH_STRIDE = 0.1
_Moved = tuple[jax.Array, jax.Array, jax.Array]


class _Probe(NamedTuple):
    """One probe; its whole state is its unmasked observation.

    Attributes:
      start: `key -> observation`.
      step: `(physics, observation, action) -> observation, reward, terminal`.
      joints: a name for every action.
      episode_length: steps.
    """

    start: Callable[[jax.Array], jax.Array]
    step: Callable[[jax.Array, jax.Array, jax.Array], _Moved]
    joints: tuple[str, ...] = ("x",)
    episode_length: int = 5


def make_domain(name: str) -> Domain:
    """Makes a probe; the same name gives the identical object.

    Best values below are for the unchanged task and discount γ. All probes but
    `endless` and `reach` end themselves, before their time limit.

    - `reach`: a point in the square [-1, 1]², 20 steps, no end of its own. An
      action moves it by 0.1 of itself; the reward is minus the squared distance
      to `extra["goal"]` after the move. The goal is not observed, so tasks
      conflict. Best action: `clip((goal - position) / 0.1, -1, 1)`.
    - `constant`: one step, reward 1. Value 1.
    - `observation`: one step, observation -1 or 1, reward equal to it. Value:
      the observation.
    - `discount`: observation 0, then 1, reward 1 on the second and last step.
      Values γ and 1.
    - `action`: one step, reward -(action - 0.5)². Best action 0.5, value 0.
    - `match`: one step, observation in [-0.5, 0.5], reward
      -(action - observation)². Best action the observation, value 0.
    - `endless`: reward 1 on every step, cut off after 4. Value 1 / (1 - γ) if the
      critic bootstraps beyond the cut, 1 / (1 - 3γ/4) if it treats the cut as an
      end. (The observation does not show the step, so the second value is the
      fixed point over four equally frequent steps.)

    Args:
      name: one of the above.

    Returns:
      The domain. `make_task` understands `actions` (joints `x` and, in `reach`,
      `y`), `hidden` and, only in `reach`, `extra["goal"]`, two coordinates.

    Raises:
      UserError: no such probe.
    """
    task_parameters.check_names("probe", [name], list(_PROBES))
    return _make_domain(name)


@functools.cache
def _make_domain(name: str) -> Domain:
    probe = _PROBES[name]
    size = jax.eval_shape(probe.start, jax.random.key(0)).shape[0]

    def reset(task: Task, key: jax.Array) -> State:
        inner = probe.start(key)
        return State(
            inner=inner,
            observation=inner * task.observation_mask,
            reward=jnp.zeros(()),
            terminal=jnp.zeros((), bool),
        )

    def step(task: Task, state: State, action: jax.Array) -> State:
        inner, reward, terminal = probe.step(
            task.physics, state.inner, action * task.action_scale
        )
        return State(inner, inner * task.observation_mask, reward, terminal)

    def make_task(change: TaskChange) -> Task:
        if change.bodies or change.gravity != 1 or change.friction != 1:
            raise UserError(
                f"Probes have no gravity, friction or bodies: task {change.name!r}."
            )
        return Task(
            physics=_goal(name, change),
            action_scale=task_parameters.action_scale(probe.joints, change.actions),
            observation_mask=task_parameters.observation_mask(size, change.hidden),
        )

    environment = Environment(
        reset=reset,
        step=step,
        observation_size=size,
        action_size=len(probe.joints),
        episode_length=probe.episode_length,
    )
    kept_programs.give_name(name, reset, step)
    return Domain(environment, make_task)


def _goal(name: str, change: TaskChange) -> jax.Array:
    """The goal `[2]` in `reach`, else nothing `[0]`."""
    wanted = {"goal"} if name == "reach" else set()
    if set(change.extra) != wanted:
        raise UserError(
            f"Probe {name!r} takes the extra values {sorted(wanted)}, not"
            f" {sorted(change.extra)}: task {change.name!r}."
        )
    goal = jnp.asarray(change.extra.get("goal", ()), jnp.float32)
    if wanted and goal.shape != (2,):
        raise UserError(f"A goal has two coordinates: task {change.name!r}.")
    return goal


def _zero(key: jax.Array) -> jax.Array:
    return jnp.zeros(1)


def _reach(goal: jax.Array, position: jax.Array, action: jax.Array) -> _Moved:
    position = jnp.clip(position + REACH_STRIDE * action, -1.0, 1.0)
    return position, -jnp.sum((position - goal) ** 2), jnp.zeros((), bool)


def _constant(physics: jax.Array, seen: jax.Array, action: jax.Array) -> _Moved:
    return seen, jnp.ones(()), jnp.ones((), bool)


def _observation(physics: jax.Array, seen: jax.Array, action: jax.Array) -> _Moved:
    return seen, seen[0], jnp.ones((), bool)


def _discount(physics: jax.Array, seen: jax.Array, action: jax.Array) -> _Moved:
    return jnp.ones_like(seen), seen[0], seen[0] > 0


def _action(physics: jax.Array, seen: jax.Array, action: jax.Array) -> _Moved:
    return seen, -((action[0] - 0.5) ** 2), jnp.ones((), bool)


def _match(physics: jax.Array, seen: jax.Array, action: jax.Array) -> _Moved:
    return seen, -((action[0] - seen[0]) ** 2), jnp.ones((), bool)


def _endless(physics: jax.Array, seen: jax.Array, action: jax.Array) -> _Moved:
    return seen, jnp.ones(()), jnp.zeros((), bool)


_PROBES = {
    "reach": _Probe(
        start=lambda key: jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0),
        step=_reach,
        joints=("x", "y"),
        episode_length=20,
    ),
    "constant": _Probe(_zero, _constant),
    "observation": _Probe(
        start=lambda key: jax.random.rademacher(key, (1,), jnp.float32),
        step=_observation,
    ),
    "discount": _Probe(_zero, _discount),
    "action": _Probe(_zero, _action),
    "match": _Probe(
        start=lambda key: jax.random.uniform(key, (1,), minval=-0.5, maxval=0.5),
        step=_match,
    ),
    "endless": _Probe(_zero, _endless, episode_length=4),
}
NAMES = tuple(_PROBES)
