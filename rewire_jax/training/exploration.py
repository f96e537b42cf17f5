"""Exploration: actions in training, and their noise."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core.settings import SacSettings
from rewire_jax.methods.base import Method, MethodState, Params
from rewire_jax.nn import networks
from rewire_jax.training import colored_noise, random_keys
from rewire_jax.training.random_keys import CollectKeys


class ActionNoise(NamedTuple):
    """The random numbers of one step of all environments of a member.

    Attributes:
      context: key of the method's context, `[2]` uint32.
      extras: key of the method's extras, `[2]` uint32.
      noise: `[envs, actions]`, noise of the policy's actions.
      uniform: `[envs, actions]`, uniform actions.
      blind: `[]` bool, whether the uniform actions are used.
    """

    context: jax.Array
    extras: jax.Array
    noise: jax.Array
    uniform: jax.Array
    blind: jax.Array


def sample_action_noise(
    key: jax.Array,
    time: jax.Array,
    size: tuple[int, int],
    random: int,
    sequence: jax.Array | None,
) -> ActionNoise:
    """Returns the random numbers of one step.

    Args:
      key: a random key.
      time: `[]` int, vector steps so far in the task.
      size: shape of the actions, `envs, actions`.
      random: number of steps at the start of the task with uniform actions.
      sequence: the coloured noise that contains this step; None for white noise.
    """
    keys = random_keys.named(CollectKeys, key)
    if sequence is None:
        noise = jax.random.normal(keys.action, size)
    else:
        noise = sequence[time % len(sequence)]
    return ActionNoise(
        context=jax.random.key_data(keys.context),
        extras=jax.random.key_data(keys.extras),
        noise=noise,
        uniform=jax.random.uniform(keys.uniform, size, minval=-1.0),
        blind=time < random,
    )


def explore(
    draw: ActionNoise,
    acting: tuple[Params, MethodState],
    extras: Any,
    observation: jax.Array,
    steps: jax.Array,
    method: Method,
) -> tuple[jax.Array, Any]:
    """Returns the exploring actions of all environments of a member.

    Args:
      draw: the random numbers.
      acting: the method's parameters and state.
      extras: the method's extras of the previous step.
      observation: `[envs, observations]`.
      steps: `[envs]` int, steps made in the running episodes.
      method: the method.

    Returns:
      Actions `[envs, actions]`, and the extras of this step.
    """
    params, method_state = acting
    extras_key, context_key = map(jax.random.wrap_key_data, (draw.extras, draw.context))
    extras = method.extras(extras_key, method_state, extras, steps)
    context = method.context(context_key, method_state, "act", extras)
    mean, log_std = method.distribution(params, method_state, context, observation)
    action, _ = networks.sample_action(draw.noise, mean, log_std)
    return jnp.where(draw.blind, draw.uniform, action), extras


def sample_colored(
    key: jax.Array,
    time: jax.Array,
    size: tuple[int, ...],
    length: int,
    settings: SacSettings,
) -> jax.Array:
    """Returns the coloured noise `[length, *size]` of the episode with a step.

    Args:
      key: the member's key for this task.
      time: `[]` int, the step.
      size: shape of the noise in a step.
      length: steps of an episode.
      settings: SAC's settings.
    """
    noise_key = random_keys.of_step(key, time - time % length).noise
    return colored_noise.colored(noise_key, settings.noise_color, length, size)
