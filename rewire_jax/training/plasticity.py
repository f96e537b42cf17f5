"""Plasticity of the networks: metrics of it, and ReDo, which resets dormant neurons."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rewire_jax.core.settings import SacSettings
from rewire_jax.core.transition import Batch
from rewire_jax.methods.base import Method
from rewire_jax.methods.round import Round
from rewire_jax.nn import dormancy, networks
from rewire_jax.training import random_keys
from rewire_jax.training.random_keys import RedoKeys
from rewire_jax.training.sac import Metrics, TrainState


def critic_activations(
    learner: TrainState, batch: Batch, method: Method, sac: SacSettings
) -> list[jax.Array]:
    """Activations `[2, batch, hidden]` of each hidden layer of both critics."""
    inputs = method.critic_input(batch.extras, batch.observation)
    inputs = jnp.concatenate([inputs, batch.action], axis=-1)
    hidden = networks.hidden_of(sac.network)
    return jax.vmap(hidden, (0, None))(learner.critic, inputs)


def metrics(
    learner: TrainState, batch: Batch, method: Method, sac: SacSettings
) -> Metrics:
    """Share of dormant neurons, and effective rank of the last hidden layer.

    The critics' are means over both. Those of the policy are missing if the method
    does not tell its `hidden` activations.
    """
    activations = {"critic": critic_activations(learner, batch, method, sac)}
    if method.hidden is not None:
        activations["policy"] = method.hidden(
            learner.params, learner.method_state, batch.observation
        )
    found = {}
    for name, layers in activations.items():
        neurons = [dormancy.dormant(x, sac.dormant_threshold) for x in layers]
        found[f"dormant_{name}"] = jnp.mean(jnp.concatenate(neurons, axis=-1))
        found[f"rank_{name}"] = jnp.mean(dormancy.effective_rank(layers[-1]))
    return found


def redo_in_time(
    key: jax.Array,
    learner: TrainState,
    sample: Callable[[jax.Array], Batch],
    made: Round,
    method: Method,
    sac: SacSettings,
) -> TrainState:
    """Resets dormant neurons if another `redo_every` updates are complete.

    Args:
      key: a random key.
      learner: the member's learner.
      sample: `key -> Batch`, draws a batch of the buffer.
      made: the round that was just made.
      method: the member's method.
      sac: SAC's settings.
    """
    policy_state, critic_state, temperature_state = learner.optimizers
    # Only what the branch changes goes through it: the rest would be copied.
    critic = learner.critic, critic_state
    policy = (learner.params, policy_state) if method.redo_policy else ()

    critic, policy = jax.lax.cond(
        made.completes(sac.redo_every),
        lambda _: _redo(random_keys.named(RedoKeys, key), learner, sample, method, sac),
        lambda parts: parts,
        (critic, policy),
    )
    params, policy_state = policy or (learner.params, policy_state)
    return learner._replace(
        params=params,
        critic=critic[0],
        optimizers=(policy_state, critic[1], temperature_state),
    )


def _redo(
    keys: RedoKeys,
    learner: TrainState,
    sample: Callable[[jax.Array], Batch],
    method: Method,
    sac: SacSettings,
) -> tuple[Any, Any]:
    """Critics and policy with their optimisers' states, reset; `()` for no policy."""
    batch = sample(keys.batch)
    params, critic = learner.params, learner.critic
    policy_state, critic_state, _ = learner.optimizers

    def renew(layers, optimizer, activations, fresh):
        neurons = [dormancy.dormant(x, sac.dormant_threshold) for x in activations]
        zeros = jax.tree.map(jnp.zeros_like, layers)
        return dormancy.renew(layers, neurons, fresh), optimizer._replace(
            mu=dormancy.renew(optimizer.mu, neurons, zeros),
            nu=dormancy.renew(optimizer.nu, neurons, zeros),
        )

    # The targets stay as they are, and follow the critics.
    critic = renew(
        critic,
        critic_state,
        critic_activations(learner, batch, method, sac),
        jax.vmap(lambda k: networks.init_mlp(k, networks.sizes(critic)))(
            jax.random.split(keys.critic)
        ),
    )
    if not method.redo_policy:
        return critic, ()
    assert method.hidden is not None
    return critic, renew(
        params,
        policy_state,
        method.hidden(params, learner.method_state, batch.observation),
        networks.init_mlp(keys.policy, networks.sizes(params)),
    )
