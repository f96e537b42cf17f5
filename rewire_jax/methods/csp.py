"""CSP: a subspace of policies, spanned by anchors (Gaya et al., arXiv 2211.10110).

`csp` builds the method from the functions of this file. The first argument of each is
its `Design`. *Weights* in this file are mixture weights of anchors.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core.pytrees import count, learned_place, put, tile
from rewire_jax.methods.base import (
    Candidates,
    Method,
    Policy,
    Purpose,
    Selection,
    Tools,
)
from rewire_jax.methods.csp_settings import CspSettings
from rewire_jax.methods.held_extras import held
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.nn.networks import Linear

Params = tuple[Linear, ...]
"""The newest anchor: layers of a plain policy."""


class State(NamedTuple):
    """The state that is carried from task to task.

    Attributes:
      learned: `[]` int32, finished tasks.
      frozen: `[]` int32, number of anchors kept. In the arrays below, entries from
        this index on are unused; during training, this index means the newest anchor.
      anchors: layers stacked on a leading axis `[tasks]`.
      best: `[tasks, tasks]`, for each finished task the weights of the anchors.
      proposals: `[rollouts, tasks]`, weights that the search found: the first half
        in the new subspace, the second in the former.
    """

    learned: jax.Array
    frozen: jax.Array
    anchors: tuple[Linear, ...]
    best: jax.Array
    proposals: jax.Array


class Design(NamedTuple):
    """The first argument of the method's functions; only its floats may be traced.

    Attributes:
      spec: sizes of the networks and of the sequence.
      options: the method's settings.
    """

    spec: Spec
    options: CspSettings


def csp(spec: Spec, options: CspSettings) -> Method:
    """Policies are weighted means of anchors; each task may add one.

    Only the newest anchor is trained, by policies drawn from the simplex that it
    spans with the frozen ones. Extras and contexts are weights `[..., tasks]`, which
    the critics see, too. At a task's end the critics propose weights with and
    without the newest anchor; by their returns it is kept or dropped.
    """
    design = Design(spec, options)
    return Method(
        init=partial(init, design),
        distribution=partial(distribution, design),
        policy=policy,
        act=networks.policy_of(spec.network),
        size=size,
        extras=partial(draw_extras, design),
        context=partial(draw_context, design),
        critic_input=critic_input,
        critic_extra=spec.tasks,
        fresh_critic=True,
        consolidate=partial(propose, design),
        hidden=partial(hidden, design),
        candidates=partial(candidates, design),
        in_budget=True,
        candidate_score=options.candidate_score,
        end_task=partial(end_task, design),
    )


def init(design: Design, key: jax.Array) -> tuple[Params, State]:
    """See `base.Init`."""
    spec, options = design
    params = networks.init_mlp(key, spec.sizes(options.width))
    return params, State(
        learned=jnp.zeros((), jnp.int32),
        frozen=jnp.zeros((), jnp.int32),
        anchors=tile(jax.tree.map(jnp.zeros_like, params), spec.tasks),
        best=jnp.zeros((spec.tasks, spec.tasks)),
        proposals=jnp.zeros((options.rollouts, spec.tasks)),
    )


def from_former(
    design: Design, key: jax.Array, state: State, shape: tuple[int, ...]
) -> jax.Array:
    """Weights `[*shape, tasks]` of a policy in the frozen anchors' subspace."""
    # Before there is a frozen anchor, all weight is on the first.
    return dirichlet(key, design.spec.tasks, jnp.maximum(state.frozen, 1), shape)


def from_new(
    design: Design, key: jax.Array, state: State, shape: tuple[int, ...]
) -> jax.Array:
    """Weights `[*shape, tasks]` of a policy in the subspace with the newest anchor."""
    anchors = state.frozen + 1
    last = anchors**2 if design.options.distribution == "peaked" else None
    return dirichlet(key, design.spec.tasks, anchors, shape, last)


def draw_extras(
    design: Design,
    key: jax.Array,
    state: State,
    extras: jax.Array | None,
    steps: jax.Array,
) -> jax.Array:
    """Weights `[envs, tasks]`, half of them from either subspace, held for a while."""
    new_key, former_key = jax.random.split(key)
    in_new = jnp.arange(steps.size) < (steps.size + 1) // 2
    drawn = jnp.where(
        in_new[:, None],
        from_new(design, new_key, state, steps.shape),
        from_former(design, former_key, state, steps.shape),
    )
    return held(extras, drawn, steps, design.options.resample_every)


def draw_context(
    design: Design, key: jax.Array, state: State, purpose: Purpose, extras: jax.Array
) -> jax.Array:
    """The stored weights or, for updates of the policy, new ones."""
    # As in the paper, Q is that of the policy with the stored weights, now and in
    # the next state.
    redrawn = purpose == "critic" and design.options.next_weights == "redrawn"
    if purpose == "policy" or redrawn:
        return from_new(design, key, state, extras.shape[:-1])
    return extras


def distribution(
    design: Design,
    params: Params,
    state: State,
    context: jax.Array,
    observation: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Mean and log-std of the weighted policies; gradients reach the newest anchor."""
    activation = networks.ACTIVATIONS[design.spec.network]
    newest = context[..., state.frozen, None]
    x, below = observation, None
    for index, layer in enumerate(params):
        if index:
            x = below = networks.between(activation, x, below)
        # A layer is linear in its parameters, so its outputs can be mixed.
        frozen = state.anchors[index]
        outputs = jnp.einsum("...i,aoi->...ao", x, frozen.weight) + frozen.bias
        mixed = jnp.sum(context[..., None] * outputs, axis=-2)
        x = mixed + newest * networks.affine(layer, x)
    return networks.gaussian(x)


def hidden(
    design: Design, params: Params, state: State, observation: jax.Array
) -> list[jax.Array]:
    """See `base.Hidden`; of the mean of the anchors, the newest among them."""
    anchors = put(state.anchors, state.frozen, params)
    used = jnp.arange(design.spec.tasks) <= state.frozen
    mean = fold(anchors, used / (state.frozen + 1))
    return networks.hidden_of(design.spec.network)(mean, observation)


def critic_input(context: jax.Array, observation: jax.Array) -> jax.Array:
    """The observation and the weights."""
    return jnp.concatenate([observation, context], axis=-1)


def propose(
    design: Design,
    key: jax.Array,
    params: Params,
    state: State,
    task: jax.Array,
    tools: Tools,
) -> tuple[Params, State]:
    """Searches either subspace for the weights that the critics value most."""
    del task
    samples, half = design.options.samples, design.options.rollouts // 2
    new_key, former_key, key = jax.random.split(key, 3)
    weights = jnp.concatenate(
        [
            dirichlet(new_key, design.spec.tasks, state.frozen + 1, (samples,)),
            from_former(design, former_key, state, (samples,)),
        ]
    )

    def estimate(total, key):
        batch = tools.sample(key, 2 * samples)
        value, _ = tools.q(weights, batch.observation, batch.action)
        return total + value, None

    keys = jax.random.split(key, design.options.estimations)
    total, _ = jax.lax.scan(estimate, jnp.zeros(2 * samples), keys)
    _, top = jax.lax.top_k(total.reshape(2, samples), half)
    chosen = top + samples * jnp.arange(2)[:, None]
    return params, state._replace(proposals=weights[chosen.reshape(-1)])


def candidates(
    design: Design, params: Params, state: State, task: jax.Array
) -> Candidates:
    """The policies of the proposed weights, if there are several anchors."""
    del task
    anchors = put(state.anchors, state.frozen, params)
    policies = jax.vmap(fold, (None, 0))(anchors, state.proposals)
    several = jnp.broadcast_to(state.frozen > 0, design.options.rollouts)
    return Candidates(policies, several)


def end_task(
    design: Design,
    params: Params,
    state: State,
    task: jax.Array,
    selection: Selection | None,
) -> tuple[Params, State]:
    """Keeps the newest anchor if it improves the return, and the best weights."""
    slot = jnp.arange(design.spec.tasks)
    weights = jnp.where(slot == state.frozen, 1.0, 0.0)
    kept = jnp.asarray(True)
    if selection is not None:
        half = design.options.rollouts // 2
        returns = selection.ranked.reshape(2, half)
        new, former = jnp.max(returns, axis=1)
        better = new > (1 + design.options.improvement) * former
        first = state.frozen == 0
        kept = first | better
        winner = jnp.argmax(returns, axis=1)
        chosen = jnp.where(better, winner[0], half + winner[1])
        weights = jnp.where(first, weights, state.proposals[chosen])
    anchors = jax.tree.map(
        lambda a, b: jnp.where(kept, a, b),
        put(state.anchors, state.frozen, params),
        state.anchors,
    )
    frozen = state.frozen + kept
    # The next anchor starts as the mean of the frozen ones.
    return fold(anchors, (slot < frozen) / frozen), state._replace(
        learned=state.learned + 1,
        frozen=frozen,
        anchors=anchors,
        best=state.best.at[task].set(weights),
    )


def policy(params: Params, state: State, task: jax.Array) -> Policy:
    """The plain MLP of a task's best weights; a new task gets the latest's."""
    folded = fold(state.anchors, state.best[learned_place(task, state.learned)])
    return jax.tree.map(lambda a, b: jnp.where(state.learned > 0, a, b), folded, params)


def size(params: Params, state: State) -> jax.Array:
    """Numbers in the frozen anchors."""
    # As in the authors' code, the tasks' few weights are not counted.
    return jnp.maximum(state.frozen, 1) * count(params)


def dirichlet(
    key: jax.Array,
    slots: int,
    used: jax.Array,
    shape: tuple[int, ...],
    last: jax.Array | None = None,
) -> jax.Array:
    """Weights from Dirichlet(1, ..., 1, last) on the first slots, 0 in the others.

    Args:
      key: a random key.
      slots: length of the weights.
      used: `[]` int, slots in use, at least 1.
      shape: shape of the draws.
      last: `[]`, the concentration of the last slot in use; None for 1.

    Returns:
      `[*shape, slots]`, not negative, with sum 1.
    """
    flat_key, last_key = jax.random.split(key)
    slot = jnp.arange(slots)
    # Gamma draws are normalised. The logarithm of one from Gamma(1) is minus a
    # Gumbel draw, which costs far less than to draw by rejection.
    logs = -jax.random.gumbel(flat_key, (*shape, slots))
    if last is not None:
        peak = jax.random.loggamma(last_key, last, shape)[..., None]
        logs = jnp.where(slot == used - 1, peak, logs)
    return jax.nn.softmax(jnp.where(slot < used, logs, -jnp.inf))


def fold(anchors: tuple[Linear, ...], weights: jax.Array) -> tuple[Linear, ...]:
    """The plain MLP whose layers are sums of those of the anchors.

    Args:
      anchors: layers stacked on a leading axis `[anchors]`.
      weights: `[anchors]`. An anchor of weight 0 cannot change any bit, even if it
        holds numbers that are not finite.
    """

    def mix(stacked):
        column = weights.reshape(-1, *[1] * (stacked.ndim - 1))
        return jnp.sum(jnp.where(column > 0, column * stacked, 0.0), axis=0)

    return jax.tree.map(mix, anchors)
