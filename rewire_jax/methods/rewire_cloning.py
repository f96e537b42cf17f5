"""Rewiring with cloning: the policies of earlier tasks keep what they did.

The cloning loss is that of the policy which an earlier task would have if the current
task ended now: its wiring, refined by the current adapters, and its head on the current
hidden layers.
"""

import jax

from rewire_jax.core.pytrees import at
from rewire_jax.methods import cloning, wiring
from rewire_jax.methods.base import Method
from rewire_jax.methods.rewire_state import Design, Params, State
from rewire_jax.nn import networks


def with_cloning(design: Design, method: Method) -> Method:
    """Returns the rewiring method `method` with the cloning loss."""
    options = design.options

    def init(key):
        params, state = method.init(key)
        memory = cloning.empty(design.spec, design.slots, options.cloning_states)
        return params, state._replace(memory=memory)

    def penalty(key, params, state, *rest):
        key, cloning_key = jax.random.split(key)
        others, metrics = method.penalty(key, params, state, *rest)
        cloned = loss(design, cloning_key, params, state)
        return others + options.cloning * cloned, metrics | {"cloning": cloned}

    def consolidate(key, params, state, task, tools):
        states = tools.sample(key, options.cloning_states).observation
        memory = cloning.store_states(state.memory, task % design.slots, states)
        return params, state._replace(memory=memory)

    def end_task(params, state, task, selection):
        # The wiring, and so the policy, is chosen only here.
        params, state = method.end_task(params, state, task, selection)
        policy = method.policy(params, state, task)
        memory = cloning.store_policy(
            state.memory, task % design.slots, lambda x: method.act(policy, x)
        )
        return params, state._replace(memory=memory)

    return method._replace(
        init=init,
        penalty=penalty,
        consolidate=consolidate,
        end_task=end_task,
        stored=lambda params, state: cloning.stored(state.memory, state.learned),
    )


def loss(design: Design, key: jax.Array, params: Params, state: State) -> jax.Array:
    """Returns the cloning loss `[]`; it trains the hidden layers and nothing else.

    The heads keep still: a task that fails restores no other head than its own.
    """
    activation = networks.ACTIVATIONS[design.spec.network]
    heads = jax.lax.stop_gradient(params.heads)
    orders = wiring.refine(state.orders, params.adapters)

    def policy(slot, observation):
        # States have different wirings: outputs are fewer than weights to reorder.
        x, below = observation, None
        for layer, order in zip(params.hidden, orders[slot], strict=True):
            x = networks.affine(layer, x)[order]
            x = below = networks.between(activation, x, below)
        return networks.gaussian(networks.affine(at(heads, slot), x))

    earlier = cloning.earlier_slots(state.memory, state.learned)
    return cloning.loss(key, state.memory, earlier, cloning.BATCH, policy)
