"""SBX's SAC on our environments, stepped through its vectorised interface."""

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from gymnasium import spaces
from sbx import SAC
from sbx.common.type_aliases import ReplayBufferSamplesNp
from stable_baselines3.common.vec_env import VecEnv

from experiments.speed.timing import Loop
from experiments.speed.vector import Vector
from rewire_jax.core.settings import Settings
from rewire_jax.core.transition import Batch
from rewire_jax.envs.base import Environment, Task


class Adapter(VecEnv):
    """Our environments as Stable-Baselines3 has them."""

    render_mode = None

    def __init__(self, vector: Vector):
        """Steps these."""
        environment, self.vector = vector.environment, vector
        limits = -np.inf, np.inf, (environment.observation_size,)
        super().__init__(
            vector.count,
            spaces.Box(*limits, dtype=np.float32),
            spaces.Box(-1, 1, (environment.action_size,), np.float32),
        )

    def reset(self) -> Any:
        """The observations as they are."""
        return self.vector.observation

    def step_async(self, actions: Any) -> None:
        """Keeps the actions."""
        self.actions = actions

    def step_wait(self) -> Any:
        """Steps; where an episode ends, the information has its last observation."""
        step = self.vector.step(self.actions)
        done = step.terminal | step.truncated
        infos: list[dict[str, Any]] = [{} for _ in done]
        for number in np.flatnonzero(done):
            infos[number]["terminal_observation"] = step.final_obs[number]
        return self.vector.observation, step.reward, done, infos

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the whole, as often as there are environments."""
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """There are none."""
        raise NotImplementedError

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """There are none."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Sequence[bool]:
        """They are not."""
        return [False] * self.num_envs


def make(settings: Settings, environment: Environment, task: Task) -> SAC:
    """The algorithm with our sizes."""
    sac = settings.sac
    return SAC(
        "MlpPolicy",
        Adapter(Vector(environment, task, settings.envs)),
        learning_rate=sac.lr_policy,
        qf_learning_rate=sac.lr_critic,
        buffer_size=settings.interactions,
        learning_starts=settings.warmup,
        batch_size=sac.batch_size,
        tau=sac.target_rate,
        gamma=sac.discount,
        train_freq=1,
        gradient_steps=settings.updates,
        policy_delay=sac.policy_delay,
        ent_coef=f"auto_{sac.initial_temperature}",
        policy_kwargs={
            "net_arch": [sac.hidden] * sac.depth,
            "activation_fn": nn.leaky_relu,
        },
        seed=0,
    )


def update_loop(
    settings: Settings, environment: Environment, task: Task, batches: Batch
) -> Loop:
    """All the given batches, once or more often."""
    model = make(settings, environment, task)
    flat = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:]), jax.tree.map(np.asarray, batches)
    )
    data = ReplayBufferSamplesNp(
        flat.observation,
        flat.action,
        flat.next_observation,
        flat.terminal.astype(np.float32),
        flat.reward,
        np.full(len(flat.reward), settings.sac.discount, np.float32),
    )
    policy = model.policy
    state = (policy.qf_state, policy.actor_state, model.ent_coef_state, model.key)
    steps = len(batches.reward)
    delay = settings.sac.policy_delay

    def loop(count):
        nonlocal state
        for _ in range(count):
            *state, _ = model._train(
                model.tau, model.target_entropy, steps, data, delay, 0, *state
            )
        return state[3]

    return loop


def whole_loop(settings: Settings, environment: Environment, task: Task) -> Loop:
    """Steps of all environments with all their updates, once these are under way."""
    model = make(settings, environment, task)
    model.learn(settings.warmup + settings.envs, log_interval=None)

    def loop(count):
        model.learn(count * settings.envs, log_interval=None, reset_num_timesteps=False)
        return model.policy.actor_state.params

    return loop
