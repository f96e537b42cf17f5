"""Rewire: multi-mode wirings, their cache, distillation and alignment.

`rewire` builds the method from the functions of this file. The first argument of each
is its `Design`. The modes are in `rewire_modes.py`, the losses in `rewire_losses.py`.
"""

from functools import partial

import jax
import jax.numpy as jnp

from rewire_jax.core.arguments import require
from rewire_jax.core.pytrees import at, count, put, tile
from rewire_jax.methods import rewire_alignment, wiring
from rewire_jax.methods.base import Candidates, Method, Policy, Selection
from rewire_jax.methods.rewire_cloning import with_cloning
from rewire_jax.methods.rewire_losses import Gaussian, distillation_loss, gaussian_kl
from rewire_jax.methods.rewire_modes import (
    distribution,
    draw_context,
    draw_extras,
    forward,
    hidden,
    mode_policies,
)
from rewire_jax.methods.rewire_settings import DISTILLED_STATES, RewireSettings
from rewire_jax.methods.rewire_state import Context, Design, Params, State
from rewire_jax.methods.round import Round
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks

Metrics = dict[str, jax.Array]


def rewire(spec: Spec, options: RewireSettings) -> Method:
    """The method of the paper.

    Raises:
      UserError: the network does not fit the alignment.
    """
    require(
        spec.network != "residual" or options.alignment == "off",
        "--network residual: its neurons have fixed places, so wirings cannot be "
        "refined; add --alignment off",
    )
    slots = spec.slots(options.head_slots)
    design = Design(
        spec=spec,
        options=options,
        n=options.width or spec.hidden,
        slots=slots,
        cached=slots if options.caching else 1,
        modes=jnp.asarray(options.modes),
    )
    method = Method(
        init=partial(init, design),
        start_task=partial(start_task, design),
        extras=partial(draw_extras, design),
        context=partial(draw_context, design),
        distribution=partial(distribution, design),
        penalty=partial(penalty, design),
        inspect=partial(inspect, design),
        hidden=partial(hidden, design),
        adjust_updates=partial(adjust_updates, design),
        after_round=partial(after_round, design),
        candidates=partial(candidates, design),
        baseline=True,
        end_task=partial(end_task, design),
        policy=partial(policy, design),
        act=networks.policy_of(spec.network),
        size=partial(size, design),
    )
    return with_cloning(design, method) if options.cloning_states else method


def init(design: Design, key: jax.Array) -> tuple[Params, State]:
    """See `base.Init`."""
    spec, n, depth = design.spec, design.n, design.spec.depth
    hidden_key, head_key = jax.random.split(key)
    hidden = networks.init_mlp(hidden_key, [spec.observations, *[n] * depth])
    head = networks.init_linear(head_key, n, 2 * spec.actions)
    orders = jnp.tile(jnp.arange(n, dtype=jnp.int32), (design.cached, depth, 1))
    params = Params(
        hidden=hidden,
        heads=tile(head, design.slots),
        scores=tile(design.scores(orders[0]), design.options.mode_slots),
        adapters=wiring.identity_adapters(depth, n),
    )
    return params, State(
        learned=jnp.zeros((), jnp.int32),
        previous=hidden,
        head=head,
        orders=orders,
        intensity=jnp.ones(()),
        temperature=jnp.zeros(()),
    )


def start_task(
    design: Design, key: jax.Array, params: Params, state: State, task: jax.Array
) -> tuple[Params, State]:
    """Starts all modes from a cached wiring, and the head from the head with it."""
    del key
    source = design.known_slot(state, task)
    head = at(params.heads, source)
    order = state.orders[source % design.cached]
    return Params(
        hidden=params.hidden,
        heads=put(params.heads, task % design.slots, head),
        scores=tile(design.scores(order), design.options.mode_slots),
        adapters=wiring.identity_adapters(design.spec.depth, design.n),
    ), state._replace(head=head, intensity=jnp.ones(()), temperature=jnp.zeros(()))


def penalty(
    design: Design,
    key: jax.Array,
    params: Params,
    state: State,
    context: Context,
    observation: jax.Array,
    gaussian: Gaussian,
) -> tuple[jax.Array, Metrics]:
    """Returns 512 alpha L_KL + beta L_SP; L_SP is 0 in the first task."""
    options = design.options
    scores = params.scores[context.other]
    other = forward(design, params, state, scores, key, observation)
    l_kl = distillation_loss(other, gaussian, options.distillation)
    l_kl = jnp.where(design.modes > 1, l_kl, 0.0)
    loss = options.alpha * DISTILLED_STATES * l_kl
    l_sp = rewire_alignment.alignment_term(design, params, state)
    return loss + options.beta * l_sp, {"distillation": l_kl}


def adjust_updates(design: Design, updates: Params, state: State) -> Params:
    """Multiplies the updates of scores (by K, rate, intensity) and adapters."""
    options = design.options
    rate = 1.0 if options.mode_rate == "gradient" else design.modes
    rate *= options.score_rate * state.intensity
    return updates._replace(
        scores=updates.scores * rate,
        adapters=jax.tree.map(
            lambda update: update * options.adapter_rate, updates.adapters
        ),
    )


def after_round(
    design: Design, params: Params, state: State, made: Round
) -> tuple[Params, State]:
    """Solves for the adapters when it is time, and sets the intensity."""
    options = design.options
    if options.alignment == "matching":
        params = rewire_alignment.match_in_time(design, params, state, made)
    if options.intensity == "linear":
        share = made.after / design.spec.updates
        state = state._replace(intensity=jnp.maximum(1 - share / options.anneal, 0.0))
    if options.intensity == "temperature":
        now = made.metrics["temperature"]
        # Before the first update of the policy it is 0.
        highest = jnp.maximum(state.temperature, now)
        intensity = jnp.where(now > 0, now / highest, 1.0)
        state = state._replace(intensity=intensity, temperature=highest)
    return params, state


def choosing(design: Design, state: State) -> jax.Array:
    """`[]` bool, whether this task's mode is chosen by its return."""
    return (state.learned > 0) | design.options.select_first


def candidates(
    design: Design, params: Params, state: State, task: jax.Array
) -> Candidates:
    """Returns the policies of all modes."""
    del task
    valid = design.valid() & choosing(design, state)
    return Candidates(mode_policies(design, params, state), valid)


def inspect(
    design: Design, params: Params, state: State, observation: jax.Array
) -> Metrics:
    """Mean KL between modes, without noise and dropout; and the alignment loss."""
    modes, valid = design.modes, design.valid()
    policies = mode_policies(design, params, state)
    act = networks.policy_of(design.spec.network)
    gaussians = jax.vmap(act, (0, None))(policies, observation)
    against = jax.vmap(gaussian_kl, (None, 0))
    pairs = jnp.mean(jax.vmap(against, (0, None))(gaussians, gaussians), axis=-1)
    # The divergence of a mode from itself is 0.
    total = jnp.sum(jnp.where(valid[:, None] & valid, pairs, 0.0))
    return {
        "mode_divergence": total / jnp.maximum(modes * (modes - 1), 1),
        # Updates need only its gradient, which is cheaper than its value.
        "alignment": rewire_alignment.alignment_term(design, params, state),
    }


def select_order(
    design: Design, params: Params, state: State, selection: Selection | None
) -> tuple[jax.Array, jax.Array]:
    """Returns the order `[L, n]` of the best mode, and `[]` whether the task failed.

    It failed if the best mode's return is below the modes' average before training.
    """
    if selection is None:
        return jnp.argsort(params.scores[0], axis=-1), jnp.asarray(False)
    assert selection.before is not None  # The method sets `baseline`.
    valid = design.valid()
    after = jnp.where(valid, selection.ranked, -jnp.inf)
    before = jnp.sum(jnp.where(valid, selection.before, 0.0)) / design.modes
    chosen = jnp.where(choosing(design, state), jnp.argmax(after), 0)
    order = jnp.argsort(params.scores[chosen], axis=-1)
    return order, (state.learned > 0) & (jnp.max(after) < before)


def end_task(
    design: Design,
    params: Params,
    state: State,
    task: jax.Array,
    selection: Selection | None,
) -> tuple[Params, State]:
    """Caches the chosen wiring and refines the others (Eq. 12).

    If the task failed, everything is restored to its state before the task.
    """
    identity = wiring.identity_adapters(design.spec.depth, design.n)
    slot = task % design.slots
    order, failed = select_order(design, params, state, selection)
    began = Params(
        hidden=state.previous,
        heads=put(params.heads, slot, state.head),
        scores=params.scores,
        adapters=identity,
    )
    params = jax.tree.map(lambda a, b: jnp.where(failed, a, b), began, params)
    latest = state.orders[design.known_slot(state, task) % design.cached]
    order = jnp.where(failed, latest, order)
    refined = rewire_alignment.refined_orders(design, params, state)
    order = order.astype(refined.dtype)
    return Params(
        hidden=params.hidden,
        heads=params.heads,
        scores=tile(design.scores(order), design.options.mode_slots),
        adapters=identity,
    ), state._replace(
        learned=state.learned + 1,
        previous=params.hidden,
        orders=refined.at[slot % design.cached].set(order),
    )


def policy(design: Design, params: Params, state: State, task: jax.Array) -> Policy:
    """Returns a plain MLP in the order of the cached wiring."""
    slot = design.known_slot(state, task)
    folded = wiring.fold(params.hidden, state.orders[slot % design.cached])
    return [*folded, at(params.heads, slot)]


def size(design: Design, params: Params, state: State) -> jax.Array:
    """See `base.Size`; counts only the modes in use."""
    one_mode = design.spec.depth * design.n
    stored = count(params) - (design.options.mode_slots - design.modes) * one_mode
    if design.options.alignment == "off":
        stored -= count(params.adapters)
    return stored + count(state.previous) + count(state.head) + state.orders.size
