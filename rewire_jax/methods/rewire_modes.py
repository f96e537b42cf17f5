"""The modes of the rewiring method: which one acts or learns, and what it does.

The first argument of each function is the method's `Design`.
"""

import jax
import jax.numpy as jnp

from rewire_jax.core.pytrees import at
from rewire_jax.methods import wiring
from rewire_jax.methods.base import Extras, Policy, Purpose
from rewire_jax.methods.held_extras import held
from rewire_jax.methods.rewire_losses import Gaussian
from rewire_jax.methods.rewire_state import Context, Design, Params, State
from rewire_jax.nn import networks
from rewire_jax.nn.wired_layers import wired


def draw_extras(
    design: Design, key: jax.Array, state: State, extras: Extras, steps: jax.Array
) -> Extras:
    """Modes `[envs]` that the environments hold for a while; () if they do not."""
    del state
    if design.options.mode_steps == 1:
        return ()
    drawn = jax.random.randint(key, steps.shape, 0, design.modes)
    return held(extras, drawn, steps, design.options.mode_steps)


def draw_context(
    design: Design, key: jax.Array, state: State, purpose: Purpose, extras: Extras
) -> Context:
    """Draws a mode, another mode and, except for acting, noise on scores (Eq. 5).

    In acting, environments may hold modes of their own.
    """
    modes, shape = design.modes, (design.spec.depth, design.n)
    mode_key, other_key, noise_key, key = jax.random.split(key, 4)
    mode = jax.random.randint(mode_key, (), 0, modes)
    offset = jax.random.randint(other_key, (), 1, jnp.maximum(modes, 2))
    noise = jnp.zeros(shape)
    if purpose != "act":
        noise = design.options.noise * jax.random.gumbel(noise_key, shape)
        noise *= state.intensity
    elif design.options.mode_steps > 1:
        mode = extras
    return Context(mode, (mode + offset) % modes, noise, key)


def distribution(
    design: Design,
    params: Params,
    state: State,
    context: Context,
    observation: jax.Array,
) -> Gaussian:
    """Returns mean and log-std `[batch, actions]` of the context's mode.

    Its scores have the context's noise. If the environments hold modes of their own,
    each row is that of its environment's mode.
    """

    def of_scores(scores):
        return forward(design, params, state, scores, context.key, observation)

    if jnp.ndim(context.mode):
        # All modes act in all environments, so that no environment permutes on its own.
        every = jax.vmap(of_scores)(params.scores)
        return jax.tree.map(lambda x: x[context.mode, jnp.arange(x.shape[1])], every)
    scores = params.scores[context.mode]
    if design.options.mode_rate == "gradient":
        # Adds exactly 0, so that close scores keep their order.
        scores += (design.modes - 1) * (scores - jax.lax.stop_gradient(scores))
    return of_scores(scores + context.noise)


def forward(
    design: Design,
    params: Params,
    state: State,
    scores: jax.Array,
    key: jax.Array,
    observation: jax.Array,
) -> Gaussian:
    """Returns the wired policy of a mode with `scores` `[L, n]` (Eq. 2)."""
    activation = networks.ACTIVATIONS[design.spec.network]
    x, below = observation, None
    for layer, v in zip(params.hidden, scores, strict=True):
        key, drop_key = jax.random.split(key)
        x = wired(layer, v, design.options.tau, x)
        # The authors drop out before the permutation. Only the variance of the scores'
        # gradient differs.
        x = _dropout(drop_key, x, design.options.dropout)
        x = below = networks.between(activation, x, below)
    head = at(params.heads, design.head_slot(state))
    return networks.gaussian(networks.affine(head, x))


def mode_policies(design: Design, params: Params, state: State) -> Policy:
    """Returns all modes' policies as plain MLPs, stacked on an axis `[mode_slots]`."""
    head = at(params.heads, design.head_slot(state))

    def folded(scores):
        orders = jnp.argsort(scores, axis=-1)
        return [*wiring.fold(params.hidden, orders), head]

    return jax.vmap(folded)(params.scores)


def hidden(
    design: Design, params: Params, state: State, observation: jax.Array
) -> list[jax.Array]:
    """See `base.Hidden`; of the first mode, without noise and dropout."""
    first = jax.tree.map(lambda x: x[0], mode_policies(design, params, state))
    return networks.hidden_of(design.spec.network)(first, observation)


def _dropout(key: jax.Array, x: jax.Array, rate: float) -> jax.Array:
    if rate == 0:
        return x
    kept = jax.random.bernoulli(key, 1 - rate, x.shape)
    return jnp.where(kept, x / (1 - rate), 0.0)
