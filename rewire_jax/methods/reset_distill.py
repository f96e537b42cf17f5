"""Reset & Distill: an online policy learns each task anew, an offline one imitates it.

See arXiv 2403.05066. The offline policy is the one that is evaluated. In states of
earlier tasks it imitates itself. `docs/departures.md` lists what is different here.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from rewire_jax.core.arguments import require, require_counts, require_weights
from rewire_jax.core.pytrees import at, count, learned_place, tile
from rewire_jax.core.settings import settings
from rewire_jax.methods import cloning
from rewire_jax.methods.base import Method
from rewire_jax.methods.finetune import FinetuneSettings, ft1
from rewire_jax.methods.rewire_losses import gaussian_kl
from rewire_jax.methods.spec import Spec
from rewire_jax.nn.networks import Linear


@settings
class ResetDistillSettings:
    """Reset & Distill.

    Attributes:
      coefficient: weight of the cloning loss, the KL divergence of the offline policy
        from what it did in stored states of earlier tasks.
      states: states that are stored of each task.
      batch: states of the task in one update of the offline policy, and as many stored
        states.
      distill_updates: updates of the offline policy after each task.
      distill_rate: Adam's learning rate in them.
      head_slots: number of output heads and of slots for stored states. Task t uses
        number t modulo this, so a repeated task uses its earlier head, and its new
        states replace the old ones.
    """

    coefficient: float = 1.0
    states: int = 10_000
    batch: int = cloning.BATCH
    distill_updates: int = 40_000
    distill_rate: float = 3e-4
    head_slots: int = 4

    def checked(self) -> "ResetDistillSettings":
        """Returns the settings; `UserError` if one is invalid."""
        require_counts(self, "states", "batch", "distill_updates", "head_slots")
        require_weights(self, "coefficient")
        rate = self.distill_rate
        require(rate > 0, f"--distill-rate must be above 0, not {rate}")
        return self


def preset(scenario: str, period: int, profile: str) -> ResetDistillSettings:
    """The values of the authors' code, with a head for each different task.

    The quick profile has a tenth of the states and of the updates.
    """
    del scenario
    few = {"states": 1_000, "distill_updates": 4_000} if profile == "quick" else {}
    return ResetDistillSettings(head_slots=period, **few)


class State(NamedTuple):
    """What is carried from task to task.

    Attributes:
      learned: `[]` int32, finished tasks.
      offline: layers of the offline policy, the last one stacked `[slots]`.
      memory: the stored states, with what the offline policy did in them.
    """

    learned: jax.Array
    offline: tuple[Linear, ...]
    memory: cloning.Memory


def reset_distill(spec: Spec, options: ResetDistillSettings) -> Method:
    """The parameters are the online policy, the state holds the offline one."""
    plain = ft1(spec, FinetuneSettings())
    act = plain.act
    slots = spec.slots(options.head_slots)
    adam = optax.adam(options.distill_rate)

    def layers(offline, slot):
        return [*offline[:-1], at(offline[-1], slot)]

    def play(offline, slot, observation):
        return act(layers(offline, slot), observation)

    def init(key):
        online, _ = plain.init(key)
        offline = *online[:-1], tile(online[-1], slots)
        memory = cloning.empty(spec, slots, options.states)
        return online, State(jnp.zeros((), jnp.int32), offline, memory)

    def start_task(key, params, state, task):
        del params, task
        return plain.init(key)[0], state

    def consolidate(key, params, state, task, tools):
        slot = task % slots
        earlier = cloning.earlier_slots(state.memory, task)
        states_key, key = jax.random.split(key)

        def loss(offline, key):
            task_key, cloning_key = jax.random.split(key)
            states = tools.sample(task_key, options.batch).observation
            expert, own = act(params, states), play(offline, slot, states)
            cloned = cloning.loss(
                cloning_key,
                state.memory,
                earlier,
                options.batch,
                partial(play, offline),
                lambda stored, now: gaussian_kl(now, stored),
            )
            return jnp.mean(gaussian_kl(expert, own)) + options.coefficient * cloned

        def update(number, carry):
            offline, moments = carry
            gradient = jax.grad(loss)(offline, jax.random.fold_in(key, number))
            step, moments = adam.update(gradient, moments)
            return optax.apply_updates(offline, step), moments

        start = state.offline, adam.init(state.offline)
        offline, _ = jax.lax.fori_loop(0, options.distill_updates, update, start)
        states = tools.sample(states_key, options.states).observation
        memory = cloning.store_states(state.memory, slot, states)
        memory = cloning.store_policy(memory, slot, partial(play, offline, slot))
        return params, State(state.learned + 1, offline, memory)

    def policy(params, state, task):
        del params
        return layers(state.offline, learned_place(task % slots, state.learned))

    return plain._replace(
        init=init,
        start_task=start_task,
        fresh_critic=True,
        consolidate=consolidate,
        policy=policy,
        size=lambda params, state: jnp.asarray(count((params, state.offline))),
        stored=lambda params, state: cloning.stored(state.memory, state.learned),
    )
