"""rejax's SAC on our environments, all of it compiled.

It has no delayed policy updates, and moves its targets once for all updates between two
steps. Both is left so.
"""

from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import spaces
from gymnax.environments.environment import Environment as Gymnax
from gymnax.environments.environment import EnvParams
from rejax import SAC
from rejax.buffers import Minibatch

from experiments.speed.timing import Loop
from rewire_jax.core.settings import Settings
from rewire_jax.core.transition import Batch
from rewire_jax.envs.base import Environment, Task
from rewire_jax.training import rollout


class Adapter(Gymnax):
    """Our environment as gymnax has them; episodes start from a stored state."""

    def __init__(self, environment: Environment, task: Task):
        """Plays one task."""
        self.environment, self.task = environment, task

    @property
    def default_params(self) -> EnvParams:
        """The time limit."""
        return EnvParams(max_steps_in_episode=self.environment.episode_length)

    def reset(self, key: jax.Array, params: Any = None) -> tuple[jax.Array, Any]:
        """Begins an episode."""
        episode = rollout.begin(self.environment, self.task, key)
        return episode.state.observation, episode

    def step(self, key: jax.Array, state: Any, action: Any, params: Any = None) -> Any:
        """Steps; gymnax's own would compute a reset in each step."""
        episode, step = rollout.advance(self.environment, self.task, state, action)
        done = step.terminal | step.truncated
        return step.next_obs, episode, step.reward, done, {}

    def action_space(self, params: Any = None) -> spaces.Box:
        """From -1 to 1."""
        return spaces.Box(-1.0, 1.0, (self.environment.action_size,))

    def observation_space(self, params: Any = None) -> spaces.Box:
        """Without limits."""
        return spaces.Box(-jnp.inf, jnp.inf, (self.environment.observation_size,))


def make(settings: Settings, environment: Environment, task: Task) -> tuple[SAC, Any]:
    """The algorithm with our sizes, and its first state."""
    sac = settings.sac
    adapter = Adapter(environment, task)
    algorithm = SAC.create(
        env=adapter,
        env_params=adapter.default_params,
        agent_kwargs={"activation": "leaky_relu"},
        hidden_layer_sizes=[sac.hidden] * sac.depth,
        num_envs=settings.envs,
        num_epochs=settings.updates,
        batch_size=sac.batch_size,
        buffer_size=settings.interactions,
        fill_buffer=settings.warmup,
        learning_rate=sac.lr_policy,
        gamma=sac.discount,
        polyak=1 - sac.target_rate,
    )
    return algorithm, algorithm.init_state(jax.random.key(0))


def going_on(algorithm: SAC, state: Any, once: Any) -> Loop:
    """`once`, `(number, state) -> state`, in one compiled loop on the last state."""
    many = jax.jit(
        lambda state, count: jax.lax.fori_loop(0, count, once, state), donate_argnums=0
    )
    # Some of its arrays are there twice, and cannot be given away so. Types that are
    # not settled would compile it anew.
    state = jax.tree.map(
        lambda leaf: jnp.array(leaf, jnp.result_type(leaf), copy=True), state
    )

    def loop(count):
        nonlocal state
        state = many(state, count)
        return state.alpha_ts.params

    return loop


def update_loop(
    settings: Settings, environment: Environment, task: Task, batches: Batch
) -> Loop:
    """All the given batches, once or more often."""
    algorithm, state = make(settings, environment, task)

    def once(number, state):
        batch = jax.tree.map(lambda x: x[number % len(x)], batches)
        mini = Minibatch(
            obs=batch.observation,
            action=batch.action,
            reward=batch.reward,
            done=batch.terminal,
            next_obs=batch.next_observation,
        )
        return algorithm.update(state, mini)

    loop = going_on(algorithm, state, once)
    return lambda count: loop(count * len(batches.reward))


def whole_loop(settings: Settings, environment: Environment, task: Task) -> Loop:
    """Steps of all environments with all their updates, once these are under way."""
    algorithm, state = make(settings, environment, task)
    loop = going_on(algorithm, state, lambda _, state: algorithm.train_iteration(state))
    jax.block_until_ready(loop(settings.warmup // settings.envs + 1))
    return loop
