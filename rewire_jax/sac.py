"""Soft Actor-Critic: losses and one update, for one member."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from rewire_jax import networks
from rewire_jax.config import SacSettings
from rewire_jax.methods.base import Memory, Method, Params, Spec
from rewire_jax.replay import Batch

Metrics = dict[str, jax.Array]
_ADAM = optax.scale_by_adam()


class Learner(NamedTuple):
    """All that learning changes.

    Attributes:
      params: the method's parameters.
      memory: the method's memory.
      critic: layers of both critics, stacked on a leading axis of 2.
      target: the same, moving slowly after them.
      log_temperature: `[]`.
      optimizers: Adam's states of policy, critics and temperature.
    """

    params: Params
    memory: Memory
    critic: Any
    target: Any
    log_temperature: jax.Array
    optimizers: tuple[Any, Any, Any]


def init(key: jax.Array, method: Method, spec: Spec, sac: SacSettings) -> Learner:
    """A learner before its first task."""
    policy_key, critic_key = jax.random.split(key)
    params, memory = method.init(policy_key)
    critic = init_critic(critic_key, spec, method.extra)
    return restart(
        Learner(params, memory, critic, critic, jnp.zeros(()), ((), (), ())), sac
    )


def init_critic(key: jax.Array, spec: Spec, extra: int) -> Any:
    """Both critics, which see `extra` numbers beside observation and action."""
    inputs = spec.observations + extra + spec.actions
    sizes = [inputs, *[spec.hidden] * spec.depth, 1]
    return jax.vmap(lambda k: networks.init_mlp(k, sizes))(jax.random.split(key))


def restart(learner: Learner, sac: SacSettings) -> Learner:
    """Fresh optimisers, temperature and targets, as at the start of every task."""
    log_temperature = jnp.log(jnp.asarray(sac.initial_temperature, jnp.float32))
    return learner._replace(
        # The targets start as copies of the critics that are kept.
        target=learner.critic,
        log_temperature=log_temperature,
        optimizers=(
            _ADAM.init(learner.params),
            _ADAM.init(learner.critic),
            _ADAM.init(log_temperature),
        ),
    )


def q_values(critic: Any, inputs: jax.Array, action: jax.Array) -> jax.Array:
    """Both critics' values `[2, batch]`.

    Args:
      critic: layers of both.
      inputs: `[batch, observations + extra]`, see `Method.critic_input`.
      action: `[batch, actions]`.
    """
    inputs = jnp.concatenate([inputs, action], axis=-1)
    return jax.vmap(networks.mlp, (0, None))(critic, inputs)[..., 0]


def _critic_loss(critic, learner, batch, key, method, sac):
    context_key, action_key = jax.random.split(key)
    context = method.context(context_key, learner.memory, "critic", batch.label)
    mean, log_std = method.distribution(
        learner.params, learner.memory, context, batch.next_observation
    )
    action, log_density = networks.sample_action(action_key, mean, log_std)
    following = method.critic_input(context, batch.next_observation)
    q_next = jnp.min(q_values(learner.target, following, action), axis=0)
    soft_value = q_next - jnp.exp(learner.log_temperature) * log_density
    ended = batch.terminal
    if sac.time_limit == "terminal":
        ended = ended | batch.truncated
    target = sac.reward_scale * batch.reward
    target += sac.discount * jnp.where(ended, 0.0, soft_value)
    inputs = method.critic_input(context, batch.observation)
    q = q_values(critic, inputs, batch.action)
    error = q - jax.lax.stop_gradient(target)
    return jnp.sum(jnp.mean(error**2, axis=-1)), jnp.mean(q)


def _policy_loss(params, learner, batch, key, method):
    context_key, action_key, penalty_key = jax.random.split(key, 3)
    memory = learner.memory
    context = method.context(context_key, memory, "policy", batch.label)
    gaussian = method.distribution(params, memory, context, batch.observation)
    action, log_density = networks.sample_action(action_key, *gaussian)
    inputs = method.critic_input(context, batch.observation)
    q = jnp.min(q_values(learner.critic, inputs, action), axis=0)
    entropy = -jnp.mean(log_density)
    loss = -jnp.exp(learner.log_temperature) * entropy - jnp.mean(q)
    penalty, metrics = method.penalty(
        penalty_key, params, memory, context, batch.observation, gaussian
    )
    return loss + penalty, {"policy_loss": loss, "entropy": entropy} | metrics


def _step(gradient, state, value, rate):
    update, state = _ADAM.update(gradient, state, value)
    return jax.tree.map(lambda u: -rate * u, update), state


class _Actor(NamedTuple):
    """What an update of the policy changes."""

    params: Params
    log_temperature: jax.Array
    optimizers: tuple[Any, Any]


def _update_policy(actor, learner, batch, key, method, sac):
    gradient, metrics = jax.grad(_policy_loss, has_aux=True)(
        actor.params, learner, batch, key, method
    )
    policy_state, temperature_state = actor.optimizers
    updates, policy_state = _step(gradient, policy_state, actor.params, sac.lr_policy)
    updates = method.adjust_updates(updates, learner.memory)
    actions = batch.action.shape[-1]
    surplus = metrics["entropy"] + sac.target_multiplier * actions
    # d/d log_temperature of temperature * (entropy - target entropy)
    temperature = jnp.exp(actor.log_temperature)
    step, temperature_state = _step(
        temperature * surplus,
        temperature_state,
        actor.log_temperature,
        sac.lr_temperature,
    )
    return _Actor(
        params=optax.apply_updates(actor.params, updates),
        log_temperature=actor.log_temperature + step,
        optimizers=(policy_state, temperature_state),
    ), metrics | {"temperature": temperature}


def _actor(learner: Learner) -> _Actor:
    policy_state, _, temperature_state = learner.optimizers
    return _Actor(
        learner.params, learner.log_temperature, (policy_state, temperature_state)
    )


def policy_metrics(learner: Learner, batch: Batch, method: Method, sac: SacSettings):
    """Zeros in the shape of a policy update's metrics, to carry through a loop."""
    shapes = jax.eval_shape(
        lambda: _update_policy(
            _actor(learner), learner, batch, jax.random.key(0), method, sac
        )[1]
    )
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


def update(
    learner: Learner,
    metrics: Metrics,
    batch: Batch,
    key: jax.Array,
    count: jax.Array,
    method: Method,
    sac: SacSettings,
) -> tuple[Learner, Metrics]:
    """One update of the critics and, in its turn, of policy and targets.

    Args:
      learner: the member's learner.
      metrics: of the previous update, kept where this one makes none.
      batch: `[batch, ...]` transitions.
      key: a random key.
      count: `[]` int, updates made before in this task; it must be shared by all
        members of a population, so that the delayed updates stay real branches.
      method: the method.
      sac: SAC's settings.
    """
    critic_key, policy_key = jax.random.split(key)
    (loss, q), gradient = jax.value_and_grad(_critic_loss, has_aux=True)(
        learner.critic, learner, batch, critic_key, method, sac
    )
    _, critic_state, _ = learner.optimizers
    step, critic_state = _step(gradient, critic_state, learner.critic, sac.lr_critic)
    critic = optax.apply_updates(learner.critic, step)
    learner = learner._replace(critic=critic)
    # Only what a branch changes goes through it: the rest would be copied.
    actor, policy = jax.lax.cond(
        count % sac.policy_delay == 0,
        lambda actor: _update_policy(actor, learner, batch, policy_key, method, sac),
        lambda actor: (
            actor,
            {k: v for k, v in metrics.items() if k not in ("critic_loss", "q")},
        ),
        _actor(learner),
    )
    target = jax.lax.cond(
        count % sac.target_delay == 0,
        lambda target: optax.incremental_update(critic, target, sac.target_rate),
        lambda target: target,
        learner.target,
    )
    policy_state, temperature_state = actor.optimizers
    return learner._replace(
        params=actor.params,
        log_temperature=actor.log_temperature,
        target=target,
        optimizers=(policy_state, critic_state, temperature_state),
    ), policy | {"critic_loss": loss, "q": q}
