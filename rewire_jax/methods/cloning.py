"""Behavioural cloning: a policy is held to what it did in stored states.

At the end of a task, states from the replay buffer are stored, with the policy's mean
and log-std in them. In later tasks, a loss pulls the policy that the current weights
give for the earlier task back to these (arXiv 2209.13900).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core.pytrees import count
from rewire_jax.methods.rewire_losses import Gaussian, gaussian_kl
from rewire_jax.methods.spec import Spec

BATCH = 128
"""Stored states in one update, as in Continual World's replay methods."""


class Memory(NamedTuple):
    """Stored states; the shapes never change.

    Attributes:
      observation: `[slots, states, observations]`, a slot for each different task.
      mean: `[slots, states, actions]`, of the task's policy when the task ended.
      log_std: the same.
    """

    observation: jax.Array
    mean: jax.Array
    log_std: jax.Array


def empty(spec: Spec, slots: int, states: int) -> Memory:
    """A memory of `states` states in each slot, all of them zeros."""
    targets = jnp.zeros((slots, states, spec.actions))
    return Memory(jnp.zeros((slots, states, spec.observations)), targets, targets)


def store_states(memory: Memory, slot: jax.Array, observation: jax.Array) -> Memory:
    """Replaces a slot's states by `[states, observations]`; `store_policy` follows."""
    return memory._replace(observation=memory.observation.at[slot].set(observation))


def store_policy(
    memory: Memory, slot: jax.Array, policy: Callable[[jax.Array], Gaussian]
) -> Memory:
    """Stores what a policy does in a slot's states."""
    mean, log_std = policy(memory.observation[slot])
    return memory._replace(
        mean=memory.mean.at[slot].set(mean),
        log_std=memory.log_std.at[slot].set(log_std),
    )


def earlier_slots(memory: Memory, learned: jax.Array) -> jax.Array:
    """`[slots]` bool: they hold states of a task other than the one that is trained.

    Args:
      memory: the memory; task t uses slot t modulo the number of slots.
      learned: `[]` int, finished tasks, and so the index of the current one.
    """
    slots = len(memory.observation)
    slot = jnp.arange(slots)
    return (slot < learned) & (slot != learned % slots)


def loss(
    key: jax.Array,
    memory: Memory,
    earlier: jax.Array,
    batch: int,
    policy: Callable[[jax.Array, jax.Array], Gaussian],
    divergence: Callable[[Gaussian, Gaussian], jax.Array] = gaussian_kl,
) -> jax.Array:
    """The divergence of the current policy from the stored one in random states.

    Args:
      key: a random key.
      memory: the memory.
      earlier: `[slots]` bool, the slots to draw from, all with equal probability.
      batch: number of states, drawn with replacement.
      policy: `(slot, observation) -> mean, log-std`, of a `[]` int and
        `[observations]`: the policy of the slot's task, as it is now.
      divergence: of stored and current Gaussians; by default KL(stored || current).

    Returns:
      `[]`, the mean over states, 0 if there is no slot to draw from.
    """
    slot_key, state_key = jax.random.split(key)
    odds = jnp.where(earlier, 0.0, -jnp.inf)
    slot = jax.random.categorical(slot_key, odds, shape=(batch,))
    state = jax.random.randint(state_key, (batch,), 0, memory.mean.shape[1])
    drawn = jax.tree.map(lambda x: x[slot, state], memory)
    now = jax.vmap(policy)(slot, drawn.observation)
    lost = jnp.mean(divergence((drawn.mean, drawn.log_std), now))
    return jnp.where(jnp.any(earlier), lost, 0.0)


def stored(memory: Memory, learned: jax.Array) -> jax.Array:
    """`[]` int, how many numbers the slots hold after `learned` tasks."""
    slots = len(memory.observation)
    return jnp.minimum(learned, slots) * (count(memory) // slots)
