"""Alignment of the weights with the previous ones, in each form that the settings name.

The adapters in `Params` describe the alignment. With "matching" they are solutions of
Eq. 11, which gradients do not change; otherwise they are trained.
"""

import jax
import jax.numpy as jnp

from rewire_jax.methods import matching, wiring
from rewire_jax.methods.rewire_losses import alignment_loss, weight_loss
from rewire_jax.methods.rewire_state import Design, Params, State
from rewire_jax.methods.round import Round


def alignment_term(design: Design, params: Params, state: State) -> jax.Array:
    """L_SP or, with alignment "off", L_reg; 0 in the first task."""
    options = design.options
    if options.alignment == "off":
        loss = weight_loss(params.hidden, state.previous)
    else:
        adapters = params.adapters
        if options.alignment == "matching":
            adapters = jax.lax.stop_gradient(adapters)
        loss = alignment_loss(
            params.hidden,
            state.previous,
            adapters,
            options.adapter_tau,
            expanded=options.alignment == "expanded",
        )
    return jnp.where(state.learned > 0, loss, 0.0)


def match_in_time(design: Design, params: Params, state: State, made: Round) -> Params:
    """Solves for the adapters if `match_every` updates have passed."""
    adapters = jax.lax.cond(
        made.completes(design.options.match_every),
        lambda: matching.match(params.hidden, state.previous, params.adapters),
        lambda: params.adapters,
    )
    return params._replace(adapters=adapters)


def refined_orders(design: Design, params: Params, state: State) -> jax.Array:
    """The cached orders after a task (Eq. 12), which the first task does not change."""
    adapters = params.adapters
    if design.options.alignment == "matching":
        adapters = matching.match(params.hidden, state.previous, adapters)
    refined = wiring.refine(state.orders, adapters)
    return jnp.where(state.learned > 0, refined, state.orders)
