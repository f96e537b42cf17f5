"""Soft Actor-Critic: losses and one update, for one member."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from rewire_jax.core.settings import Network, SacSettings
from rewire_jax.core.transition import Batch
from rewire_jax.methods.base import Method, MethodState, Params
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.training import critic_penalties

Metrics = dict[str, jax.Array]
_ADAM = optax.scale_by_adam()
_STATES = {"current": 1, "both": 2}  # of a transition, in the policy's losses


class TrainState(NamedTuple):
    """The part of a member's state that updates change.

    Attributes:
      params: the method's parameters.
      method_state: what the method carries from task to task.
      critic: layers of both critics, stacked on a leading axis of 2.
      target: the same, slowly updated towards `critic`.
      log_temperature: `[]`.
      optimizers: Adam's states of policy, critics and temperature.
      critic_start: the critics' first layers, with `l2_init`; else `()`.
    """

    params: Params
    method_state: MethodState
    critic: Any
    target: Any
    log_temperature: jax.Array
    optimizers: tuple[Any, Any, Any]
    critic_start: Any = ()

    def with_learned(self, learned: tuple[Params, MethodState]) -> "TrainState":
        """Returns it with the parameters and the state that a method returned."""
        params, method_state = learned
        return self._replace(params=params, method_state=method_state)


def init(key: jax.Array, method: Method, spec: Spec, sac: SacSettings) -> TrainState:
    """Returns a learner before its first task."""
    policy_key, critic_key = jax.random.split(key)
    params, method_state = method.init(policy_key)
    critic = init_critic(critic_key, spec, method.critic_extra)
    learner = TrainState(
        params, method_state, critic, critic, jnp.zeros(()), ((), (), ())
    )
    return restart(start_critic(learner, critic, sac), sac)


def start_critic(learner: TrainState, critic: Any, sac: SacSettings) -> TrainState:
    """Gives the learner new critics."""
    start = critic if sac.l2_init else ()
    return learner._replace(critic=critic, critic_start=start)


def init_critic(key: jax.Array, spec: Spec, extra: int) -> Any:
    """Returns both critics; `extra` is the input's length besides state and action."""
    inputs = spec.observations + extra + spec.actions
    sizes = [inputs, *[spec.hidden] * spec.depth, 1]
    return jax.vmap(lambda k: networks.init_mlp(k, sizes))(jax.random.split(key))


def restart(learner: TrainState, sac: SacSettings) -> TrainState:
    """Resets optimisers, temperature and targets, as at the start of each task."""
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


def q_values(
    critic: Any, inputs: jax.Array, action: jax.Array, network: Network
) -> jax.Array:
    """Returns the values of both critics, `[2, batch]`.

    Args:
      critic: layers of both.
      inputs: `[batch, observations + extra]`, see `Method.critic_input`.
      action: `[batch, actions]`.
      network: see `SacSettings`.
    """
    activation = networks.ACTIVATIONS[network]
    apply = jax.vmap(functools.partial(networks.mlp, activation=activation))
    inputs = jnp.concatenate([inputs, action], axis=-1)
    # Of one input for both, XLA would make one product, then transpose it in two.
    return apply(critic, jnp.stack([inputs, inputs]))[..., 0]


class UpdateNoise(NamedTuple):
    """The random draws of one update.

    Attributes:
      contexts: results of `Method.context`, for the critics and for the policy.
      noise: `[2 or 3, batch, actions]`, noise of the actions: first in the critics'
        targets, then in the policy's losses, for one or both states of a transition.
      penalty: a key for the method's penalty.
    """

    contexts: tuple[Any, Any]
    noise: jax.Array
    penalty: jax.Array


def sample_update_noise(
    key: jax.Array,
    method_state: MethodState,
    extras: Any,
    size: tuple[int, int],
    method: Method,
    sac: SacSettings,
) -> UpdateNoise:
    """Returns the random draws of one update.

    Args:
      key: a random key.
      method_state: the method's state, which updates do not change.
      extras: extras of the update's transitions.
      size: shape of the update's actions, `batch, actions`.
      method: the method.
      sac: SAC's settings.
    """
    critic_key, policy_key, noise_key, penalty_key = jax.random.split(key, 4)
    states = _STATES[sac.policy_states]
    acting = jax.tree.map(lambda x: jnp.concatenate([x] * states), extras)
    return UpdateNoise(
        contexts=(
            method.context(critic_key, method_state, "critic", extras),
            method.context(policy_key, method_state, "policy", acting),
        ),
        noise=jax.random.normal(noise_key, (1 + states, *size)),
        penalty=penalty_key,
    )


def _critic_loss(critic, learner, batch, draw, method, sac):
    context = draw.contexts[0]
    mean, log_std = method.distribution(
        learner.params, learner.method_state, context, batch.next_observation
    )
    action, log_density = networks.sample_action(draw.noise[0], mean, log_std)
    following = method.critic_input(context, batch.next_observation)
    q_next = jnp.min(q_values(learner.target, following, action, sac.network), axis=0)
    if sac.critic_entropy == "batch_mean":
        log_density = jnp.mean(log_density)
    soft_value = q_next - jnp.exp(learner.log_temperature) * log_density
    ended = batch.terminal
    if sac.time_limit == "terminal":
        ended = ended | batch.truncated
    target = sac.reward_scale * batch.reward
    target += sac.discount * jnp.where(ended, 0.0, soft_value)
    # The action that was taken is valued by what was stored with it.
    inputs = method.critic_input(batch.extras, batch.observation)
    q = q_values(critic, inputs, batch.action, sac.network)
    error = q - jax.lax.stop_gradient(target)
    loss = jnp.sum(jnp.mean(error**2, axis=-1))
    loss = critic_penalties.add(loss, critic, learner.critic_start, sac)
    return loss, jnp.mean(q)


def _policy_loss(params, learner, batch, draw, method, sac):
    method_state, context = learner.method_state, draw.contexts[1]
    observation = batch.observation
    if sac.policy_states == "both":
        observation = jnp.concatenate([observation, batch.next_observation])
    noise = draw.noise[1:].reshape(-1, draw.noise.shape[-1])
    gaussian = method.distribution(params, method_state, context, observation)
    action, log_density = networks.sample_action(noise, *gaussian)
    inputs = method.critic_input(context, observation)
    q = jnp.min(q_values(learner.critic, inputs, action, sac.network), axis=0)
    entropy = -jnp.mean(log_density)
    loss = -jnp.exp(learner.log_temperature) * entropy - jnp.mean(q)
    penalty, metrics = method.penalty(
        draw.penalty, params, method_state, context, observation, gaussian
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


def _update_policy(actor, learner, batch, draw, method, sac):
    gradient, metrics = jax.grad(_policy_loss, has_aux=True)(
        actor.params, learner, batch, draw, method, sac
    )
    gradient = method.adjust_gradient(gradient, learner.method_state)
    policy_state, temperature_state = actor.optimizers
    updates, policy_state = _step(gradient, policy_state, actor.params, sac.lr_policy)
    updates = method.adjust_updates(updates, learner.method_state)
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


def _actor(learner: TrainState) -> _Actor:
    policy_state, _, temperature_state = learner.optimizers
    return _Actor(
        learner.params, learner.log_temperature, (policy_state, temperature_state)
    )


def first_metrics(
    learner: TrainState,
    batch: Batch,
    draw: UpdateNoise,
    method: Method,
    sac: SacSettings,
) -> Metrics:
    """Returns the metrics for the first `update` of a round: zeros."""
    # The loss alone, without its gradient, is traced quickly.
    _, shapes = jax.eval_shape(
        lambda: _policy_loss(learner.params, learner, batch, draw, method, sac)
    )
    metrics = jax.tree.map(jnp.zeros_like, shapes)
    names = ("critic_loss", "q", "temperature")
    return metrics | {name: jnp.zeros(()) for name in names}


def _every(delay, before, change, keep, value):
    """Changes a value in every `delay`-th update only."""
    if delay == 1:  # a branch would copy
        return change(value)
    if isinstance(before, int):
        return keep(value) if before % delay else change(value)
    return jax.lax.cond(before % delay == 0, change, keep, value)


def update(
    learner: TrainState,
    metrics: Metrics,
    batch: Batch,
    draw: UpdateNoise,
    before: jax.Array | int,
    method: Method,
    sac: SacSettings,
) -> tuple[TrainState, Metrics]:
    """Updates the critics and, after their delays, the policy and the targets.

    Args:
      learner: the member's learner.
      metrics: metrics of the previous update, kept if this update computes none.
      batch: `[batch, ...]` transitions.
      draw: the random draws.
      before: `[]` int, updates made before in this task; shared by all members, so that
        delayed updates stay branches (`cond`) under vmap. A Python int decides on
        them when it is traced; see `sac_updates`.
      method: the method.
      sac: SAC's settings.
    """
    (loss, q), gradient = jax.value_and_grad(_critic_loss, has_aux=True)(
        learner.critic, learner, batch, draw, method, sac
    )
    _, critic_state, _ = learner.optimizers
    step, critic_state = _step(gradient, critic_state, learner.critic, sac.lr_critic)
    critic = optax.apply_updates(learner.critic, step)
    learner = learner._replace(critic=critic)
    # Only what a branch changes goes through it: the rest would be copied.
    actor, policy = _every(
        sac.policy_delay,
        before,
        lambda actor: _update_policy(actor, learner, batch, draw, method, sac),
        lambda actor: (
            actor,
            {k: v for k, v in metrics.items() if k not in ("critic_loss", "q")},
        ),
        _actor(learner),
    )
    target = _every(
        sac.target_delay,
        before,
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
