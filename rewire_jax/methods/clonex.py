"""ClonEx-SAC: a head for each task, cloning, exploration by the best earlier policy.

See arXiv 2209.13900; `docs/departures.md` lists what is different here.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from rewire_jax.core.arguments import require, require_counts, require_weights
from rewire_jax.core.pytrees import at, count, learned_place
from rewire_jax.core.settings import settings
from rewire_jax.methods import cloning
from rewire_jax.methods.base import Candidates, Method
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.nn.networks import Linear


@settings
class ClonexSettings:
    """ClonEx-SAC.

    Attributes:
      coefficient: weight of the cloning loss, the KL divergence from what the policy
        did in stored states of earlier tasks.
      states: states that are stored of each task.
      batch: stored states in one update of the policy.
      explore: share of a task's updates up to which an earlier head acts: the one whose
        policy has the best return on the task before its training. 1% is 10,000
        interactions of a million. With 0, or without selection episodes, the task's own
        head acts from the start.
      clip: largest norm of the policy's gradient. Longer gradients are scaled to it.
      head_slots: number of output heads and of slots for stored states. Task t uses
        number t modulo this, so a repeated task uses its earlier head, and its new
        states replace the old ones.
    """

    coefficient: float = 100.0
    states: int = 10_000
    batch: int = cloning.BATCH
    explore: float = 0.01
    clip: float = 0.1
    head_slots: int = 4

    def checked(self) -> "ClonexSettings":
        """Returns the settings; `UserError` if one is invalid."""
        require_counts(self, "states", "batch", "head_slots")
        require_weights(self, "coefficient")
        require(
            0 <= self.explore < 1, f"--explore must lie in [0, 1), not {self.explore}"
        )
        require(
            0 < self.clip < jnp.inf,
            f"--clip must be above 0 and finite, not {self.clip}",
        )
        return self


def preset(scenario: str, period: int, profile: str) -> ClonexSettings:
    """The published settings, with a head for each different task.

    The quick profile stores a tenth of the states.
    """
    del scenario
    states = 1_000 if profile == "quick" else 10_000
    return ClonexSettings(states=states, head_slots=period)


class Params(NamedTuple):
    """The policies of all tasks.

    Attributes:
      hidden: the hidden layers, which all tasks share.
      heads: output layers, stacked on a leading axis `[slots]`.
    """

    hidden: tuple[Linear, ...]
    heads: Linear


class State(NamedTuple):
    """What is carried from task to task.

    Attributes:
      learned: `[]` int32, finished tasks.
      memory: the stored states.
      explorer: `[]` int32, the head that acts at the start of the task.
      share: `[]`, share of the task's updates that were made.
    """

    learned: jax.Array
    memory: cloning.Memory
    explorer: jax.Array
    share: jax.Array


def clonex(spec: Spec, options: ClonexSettings) -> Method:
    """All tasks train the same hidden layers; cloning keeps the earlier policies."""
    act = networks.policy_of(spec.network)
    slots = spec.slots(options.head_slots)

    def layers(params, slot):
        return [*params.hidden, at(params.heads, slot)]

    def init(key):
        hidden_key, head_key = jax.random.split(key)
        *sizes, outputs = spec.sizes()
        heads = jax.vmap(lambda key: networks.init_linear(key, sizes[-1], outputs))(
            jax.random.split(head_key, slots)
        )
        hidden = tuple(networks.init_mlp(hidden_key, sizes))
        none = jnp.zeros((), jnp.int32)
        memory = cloning.empty(spec, slots, options.states)
        return Params(hidden, heads), State(none, memory, none, jnp.zeros(()))

    def start_task(key, params, state, task):
        del key
        explorer = jnp.asarray(task % slots, jnp.int32)
        return params, state._replace(explorer=explorer, share=jnp.zeros(()))

    def explores(state):
        return (state.learned > 0) & (state.share < options.explore)

    def candidates(params, state, task):
        del task
        known = jnp.arange(slots) < state.learned
        policies = jax.vmap(lambda head: [*params.hidden, head])(params.heads)
        # None at the end of a task, when only `end_task` would be told.
        return Candidates(policies, known & explores(state))

    def after_baseline(params, state, before):
        known = jnp.arange(slots) < state.learned
        returns = jnp.where(known & ~jnp.isnan(before), before, -jnp.inf)
        best = jnp.argmax(returns).astype(jnp.int32)
        return params, state._replace(explorer=best)

    def after_round(params, state, made):
        return params, state._replace(share=made.after / spec.updates)

    def context(key, state, purpose, extras):
        del key, extras
        acts = explores(state) & (purpose == "act")
        return jnp.where(acts, state.explorer, state.learned % slots)

    def distribution(params, state, context, observation):
        del state
        return act(layers(params, context), observation)

    def hidden(params, state, observation):
        policy = layers(params, state.learned % slots)
        return networks.hidden_of(spec.network)(policy, observation)

    def penalty(key, params, state, context, observation, gaussian):
        del context, observation, gaussian
        loss = cloning.loss(
            key,
            state.memory,
            cloning.earlier_slots(state.memory, state.learned),
            options.batch,
            lambda slot, stored: act(layers(params, slot), stored),
        )
        return options.coefficient * loss, {"cloning": loss}

    def clipped(gradient, state):
        del state
        clip = optax.clip_by_global_norm(options.clip)
        return clip.update(gradient, clip.init(gradient))[0]

    def consolidate(key, params, state, task, tools):
        slot = task % slots
        states = tools.sample(key, options.states).observation
        memory = cloning.store_states(state.memory, slot, states)
        memory = cloning.store_policy(
            memory, slot, lambda observation: act(layers(params, slot), observation)
        )
        return params, state._replace(memory=memory)

    def end_task(params, state, task, selection):
        del task, selection
        return params, state._replace(learned=state.learned + 1)

    def policy(params, state, task):
        return layers(params, learned_place(task % slots, state.learned))

    return Method(
        init=init,
        start_task=start_task,
        candidates=candidates,
        baseline=True,
        after_baseline=after_baseline,
        after_round=after_round,
        context=context,
        distribution=distribution,
        penalty=penalty,
        adjust_gradient=clipped,
        consolidate=consolidate,
        end_task=end_task,
        policy=policy,
        act=act,
        hidden=hidden,
        size=lambda params, state: jnp.asarray(count(params)),
        stored=lambda params, state: cloning.stored(state.memory, state.learned),
    )
