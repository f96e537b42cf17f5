"""Episodes of simulators on the host: started, stepped, and restored.

Their records are those of compiled environments, `[members, envs]` on the host. The
seed of an episode and its actions determine the state of a simulator. The actions are
in the replay buffer. So a resumed run restores a simulator by replaying the actions.
"""

# The records below have JAX arrays as types; here they contain NumPy arrays.
# mypy: disable-error-code="arg-type"

from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from rewire_jax.core.errors import UserError
from rewire_jax.envs.base import HostEnvironment, State, Task
from rewire_jax.envs.vector_env import VectorEnv, draw_seed, shown
from rewire_jax.training import rollout
from rewire_jax.training.rollout import Episode, Step, Success

Array = NDArray[Any]


def seeds(roots: Array, number: Array) -> Array:
    """Returns seeds `[members, envs]` for episode `number` of each environment."""
    return np.array(
        [
            [draw_seed(*root, env, of) for env, of in enumerate(row)]
            for root, row in zip(roots, number, strict=True)
        ]
    )


def begin(environment: HostEnvironment, number: Array, observation: Array) -> Any:
    """Environments `[members, envs]` at the start of an episode.

    An environment's inner state is the number of its episode. Unlike a compiled
    environment, it stores no initial state, because each episode has a new one.

    Args:
      environment: the environment.
      number: `[members, envs]` int32, numbers of the episodes.
      observation: `[members, envs, observations]`.
    """
    shape = number.shape
    false, zero = np.zeros(shape, bool), np.zeros(shape, np.float32)
    known = environment.success
    state = State(number, observation, zero, false, false if known else ())
    success = Success(false, false) if known else ()
    return Episode(state, (), np.zeros(shape, np.int32), zero, success)


def advance(
    environment: HostEnvironment,
    lanes: VectorEnv,
    task: Task,
    roots: Array,
    episodes: Any,
    action: Array,
) -> tuple[Any, Step]:
    """Steps all environments; ended episodes are followed by new ones.

    Args:
      environment: the environment.
      lanes: the simulators, in the states that `episodes` describes.
      task: the current task.
      roots: `[members, 2]` uint32, from which the episodes' seeds are drawn.
      episodes: episodes from `begin` or an earlier step.
      action: `[members, envs, actions]`.

    Returns:
      The episodes after it, and the step, `[members, envs]`.
    """
    shape = episodes.steps.shape
    scaled = action * np.asarray(task.action_scale)
    moment = lanes.step(scaled.reshape(-1, action.shape[-1]))
    final_obs = next_obs = shown(moment.observation, task, shape)
    reward, terminal = moment.reward.reshape(shape), moment.terminal.reshape(shape)
    known = environment.success
    solved = moment.success.reshape(shape) if known else ()
    steps, score = episodes.steps + np.int32(1), episodes.score + reward
    truncated = (steps >= environment.episode_length) & ~terminal
    success = rollout.succeed(episodes.success, solved)
    ended, number = terminal | truncated, episodes.state.inner
    after = steps, score, success
    if ended.any():
        number = number + ended.astype(np.int32)
        begun = seeds(roots, number).ravel()
        next_obs = shown(lanes.reset(lanes.task, begun, ended.ravel()), task, shape)
        after = jax.tree.map(lambda x: np.where(ended, np.zeros_like(x), x), after)
    return Episode(State(number, next_obs, reward, terminal, solved), (), *after), Step(
        reward, terminal, truncated, final_obs, next_obs, score, success
    )


def replay_actions(
    lanes: VectorEnv, task: Task, roots: Array, episodes: Any, buffer: Any, time: int
) -> None:
    """Brings the simulators where the episodes are, by playing them again.

    Args:
      lanes: wherever they are.
      task: the current task.
      roots: as in `advance`.
      episodes: as in `advance`.
      buffer: replay buffers `[members]`, which hold the episodes' actions.
      time: vector steps in the buffers.

    Raises:
      UserError: they come out elsewhere.
    """
    begun, steps = seeds(roots, episodes.state.inner).ravel(), episodes.steps.ravel()

    def there() -> bool:
        seen = shown(lanes.observation, task, episodes.steps.shape)
        return (
            lanes.task == int(task.physics)
            and np.array_equal(lanes.seeds, begun)
            and np.array_equal(lanes.steps, steps)
            and np.array_equal(seen, episodes.state.observation, equal_nan=True)
        )

    if there():
        return
    longest = int(steps.max())
    lanes.reset(int(task.physics), begun)
    rows = buffer.action.shape[1]
    # The shorter ones join later, so that all are there at the same time.
    for number in range(longest):
        if number and (joins := steps == longest - number).any():
            lanes.reset(lanes.task, begun, joins)
        action = np.asarray(buffer.action[:, (time - longest + number) % rows])
        action = action * np.asarray(task.action_scale)
        moment = lanes.step(action.reshape(len(begun), -1))
        if moment.terminal.any():  # in those that join later
            lanes.reset(lanes.task, begun, moment.terminal)
    if longest and (joins := steps == 0).any():
        lanes.reset(lanes.task, begun, joins)
    if not there():
        raise UserError(
            "the simulator does not repeat the episode that the checkpoint lies in: go "
            "on where it was written, with the same versions, or delete the checkpoint "
            "with -step- in its name, to repeat the task"
        )
