"""Steps environments: single steps of training, and whole episodes."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.envs.base import Environment, HostEnvironment, State, Task, check_state
from rewire_jax.methods.shared import axes


class Success(NamedTuple):
    """Success by two criteria, as bools or as counts.

    Attributes:
      any: solved at any step of the episode so far (as in Continual World).
      last: solved at the latest step (as in the code of the paper's authors).
    """

    any: jax.Array
    last: jax.Array


def named(success: Any) -> dict[str, Any]:
    """The parts of a `Success` by their names in result files; empty for `()`."""
    return {"success": success.any, "success_last": success.last} if success else {}


class Episode(NamedTuple):
    """One environment in training.

    Attributes:
      state: the current state.
      start: the first state of the next episode.
      steps: `[]` int32, steps of the current episode.
      score: `[]`, return of the current episode so far.
      success: `Success` of `[]` bool in it; `()` if not defined.
    """

    state: State
    start: State
    steps: jax.Array
    score: jax.Array
    success: Any = ()


class Step(NamedTuple):
    """The result of one environment step.

    Attributes:
      reward: `[]`.
      terminal: `[]` bool, ended by the task.
      truncated: `[]` bool, ended only by the time limit.
      final_obs: `[observations]`, the observation that the step led to.
      next_obs: `[observations]`, the same; after the end of an episode, the first
        observation of the next one.
      score: `[]`, return of the episode so far.
      success: `Success` of `[]` bool in it; `()` if not defined.
    """

    reward: jax.Array
    terminal: jax.Array
    truncated: jax.Array
    final_obs: jax.Array
    next_obs: jax.Array
    score: jax.Array
    success: Any = ()


class Rollout(NamedTuple):
    """Whole episodes, `[..., episodes]` each.

    Attributes:
      returns: undiscounted.
      lengths: in steps.
      success: `Success` of bools; `()` if not defined.
    """

    returns: jax.Array
    lengths: jax.Array
    success: Any = ()


def no_success(environment: Environment | HostEnvironment, shape: Any = ()) -> Any:
    """`Success` before an episode's first step; `()` if not defined."""
    none = jnp.zeros(shape, bool)
    return Success(none, none) if environment.success else ()


def succeed(before: Any, now: Any) -> Any:
    """`Success` after a step; `()` if not defined.

    Args:
      before: the episode's, before the step.
      now: bool, `State.success`.
    """
    return Success(before.any | now, now) if before else ()


def begin(environment: Environment, task: Task, key: jax.Array) -> Episode:
    """Resets an environment; raises the errors of `check_state`."""
    state = check_state(environment, environment.reset(task, key))
    none = no_success(environment)
    return Episode(state, state, jnp.zeros((), jnp.int32), jnp.zeros(()), none)


def advance(
    environment: Environment, task: Task, episode: Episode, action: jax.Array
) -> tuple[Episode, Step]:
    """Steps one environment; after an episode it returns to the stored initial state.

    A stored initial state, as in brax's wrapper, avoids a reset in every step. Each
    environment has its own initial state in each task.

    Raises:
      AssertionError: see `check_state`.
    """
    state = environment.step(task, episode.state, action)
    check_state(environment, state)
    steps = episode.steps + 1
    score = episode.score + state.reward
    success = succeed(episode.success, state.success)
    truncated = (steps >= environment.episode_length) & ~state.terminal
    ended = state.terminal | truncated
    after = jax.tree.map(lambda a, b: jnp.where(ended, a, b), episode.start, state)
    return Episode(
        state=after,
        start=episode.start,
        steps=jnp.where(ended, 0, steps),
        score=jnp.where(ended, 0.0, score),
        success=jax.tree.map(lambda x: x & ~ended, success),
    ), Step(
        reward=state.reward,
        terminal=state.terminal,
        truncated=truncated,
        final_obs=state.observation,
        next_obs=after.observation,
        score=score,
        success=success,
    )


def episodes(
    environment: Environment,
    act: Callable[[Any, jax.Array], tuple[jax.Array, jax.Array]],
    tasks: Task,
    policies: Any,
    keys: jax.Array,
    count: int,
) -> Rollout:
    """Plays whole episodes without exploration: action = tanh(mean).

    Args:
      environment: unbatched.
      act: `(policy, observation) -> mean, log_std`.
      tasks: pytree with a leading axis `[rows]`.
      policies: pytree with leading axes `[members, rows]`; `[members]` if `Shared`.
      keys: `[members, rows]`.
      count: episodes for each member and row.

    Returns:
      `[members, rows, count]`.
    """
    over = functools.partial(_over, policies)

    def reset(task, policy, key):
        return environment.reset(task, key)

    def step(task, policy, state):
        mean, _ = act(policy, state.observation)
        return environment.step(task, state, jnp.tanh(mean))

    def body(carry):
        time, state, alive, result = carry
        state = over(step)(tasks, policies, state)
        success = jax.tree.map(
            lambda new, old: jnp.where(alive, new, old),
            succeed(result.success, state.success),
            result.success,
        )
        result = Rollout(
            result.returns + jnp.where(alive, state.reward, 0.0),
            result.lengths + alive,
            success,
        )
        return time + 1, state, alive & ~state.terminal, result

    def unfinished(carry):
        time, _, alive, _ = carry
        return (time < environment.episode_length) & jnp.any(alive)

    state = over(reset)(tasks, policies, _split(keys, count))
    shape = (*keys.shape, count)
    none = no_success(environment, shape)
    result = Rollout(jnp.zeros(shape), jnp.zeros(shape, jnp.int32), none)
    carry = (jnp.zeros((), jnp.int32), state, jnp.ones(shape, bool), result)
    return jax.lax.while_loop(unfinished, body, carry)[-1]


def since_reset(
    environment: Environment,
    act: Callable[[Any, jax.Array], tuple[jax.Array, jax.Array]],
    tasks: Task,
    policies: Any,
    keys: jax.Array,
    count: int,
) -> Rollout:
    """Plays `episode_length - 1` steps, and continues after a terminal state.

    After a terminal state, the environment returns to its initial state. The score is
    the return since the latest reset, as for the candidates in the authors' CSP.
    Arguments and result are those of `episodes`.
    """
    over = functools.partial(_over, policies)
    steps = environment.episode_length - 1

    def start(task, policy, key):
        return begin(environment, task, key)

    def step(task, policy, episode):
        mean, _ = act(policy, episode.state.observation)
        return advance(environment, task, episode, jnp.tanh(mean))

    def body(_, carry):
        return over(step)(tasks, policies, carry[0])

    first = over(start)(tasks, policies, _split(keys, count))
    shapes = jax.eval_shape(body, 0, (first,))
    last = jax.tree.map(jnp.zeros_like, shapes[1])
    _, last = jax.lax.fori_loop(0, steps, body, (first, last))
    return Rollout(last.score, jnp.full(last.score.shape, steps), last.success)


PLAYS = {"episode": episodes, "since_reset": since_reset}
"""The function that plays candidates, for each `Method.candidate_score`."""


def _over(policies: Any, function: Callable[..., Any]) -> Callable[..., Any]:
    """Maps over members, rows and episodes.

    Members share a task; episodes share a policy.
    """
    function = jax.vmap(function, (None, None, 0))
    return jax.vmap(jax.vmap(function, (0, axes(policies), 0)), (None, 0, 0))


def _split(keys: jax.Array, count: int) -> jax.Array:
    """Keys `[members, rows, count]`, one for each episode."""
    return jax.vmap(jax.vmap(lambda key: jax.random.split(key, count)))(keys)
