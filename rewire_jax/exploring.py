"""Exploring actions, and the noise that they may take."""

from typing import Any

import jax
import jax.numpy as jnp

from rewire_jax import networks, noise
from rewire_jax.config import SacSettings
from rewire_jax.methods.base import Memory, Method, Params


def explore(
    key: jax.Array,
    acting: tuple[Params, Memory],
    label: Any,
    observation: jax.Array,
    steps: jax.Array,
    time: jax.Array,
    method: Method,
    random: int,
    sequence: jax.Array | None,
) -> tuple[jax.Array, Any]:
    """Exploring actions of all environments of a member.

    Args:
      key: a random key.
      acting: the method's parameters and memory.
      label: the method's, of the step before.
      observation: `[envs, observations]`.
      steps: `[envs]` int, of the running episodes.
      time: `[]` int, steps of all environments made before in the task.
      method: the method.
      random: steps in the task whose actions are uniform.
      sequence: the coloured noise that `time` lies in, None where noise is white.

    Returns:
      Actions `[envs, actions]`, and the label that belongs to the step.
    """
    params, memory = acting
    context_key, action_key, random_key, label_key = jax.random.split(key, 4)
    label = method.label(label_key, memory, label, steps)
    context = method.context(context_key, memory, "act", label)
    mean, log_std = method.distribution(params, memory, context, observation)
    if sequence is None:
        drawn = jax.random.normal(action_key, mean.shape, mean.dtype)
    else:
        drawn = sequence[time % len(sequence)]
    action, _ = networks.sample_action(drawn, mean, log_std)
    if random:
        uniform = jax.random.uniform(random_key, action.shape, minval=-1.0)
        action = jnp.where(time < random, uniform, action)
    return action, label


def draw_sequence(
    key: jax.Array,
    time: jax.Array,
    size: tuple[int, ...],
    length: int,
    settings: SacSettings,
) -> jax.Array:
    """Coloured noise `[length, *size]`, as long as an episode, that a step lies in.

    Args:
      key: the task's, as in `train`.
      time: `[]` int, of the step.
      size: of the noise in a step.
      length: of an episode.
      settings: SAC's.
    """
    # A key that the steps do not use.
    start_key = jax.random.fold_in(key, time - time % length)
    sequence_key = jax.random.split(start_key, 4)[3]
    return noise.colored(sequence_key, settings.noise_color, length, size)
