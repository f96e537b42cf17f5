"""CSP: a subspace of policies, spanned by anchors (Gaya et al., arXiv 2211.10110)."""

import dataclasses
import math
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core.settings import flag, require, settings, traced
from rewire_jax.methods.base import (
    Candidates,
    CandidateScore,
    Method,
    Spec,
    count,
    put,
    tile,
)
from rewire_jax.nn import networks
from rewire_jax.nn.networks import Linear


@settings
class CspSettings:
    """The subspace of policies.

    Attributes:
      width: neurons in each hidden layer of an anchor, 0 for the run's `hidden`.
      distribution: what weights are drawn from in training: "flat" is
        Dirichlet(1, ..., 1), "peaked" Dirichlet(1, ..., 1, n²) of n anchors, most
        of it on the newest.
      resample_every: steps of an episode for which drawn weights are held.
      improvement: an anchor is kept if its best return exceeds the former
        subspace's times one plus this; that asks for less where returns are negative.
      samples: weights that the search draws from each of the two subspaces.
      estimations: transitions over which it takes the mean of each one's value.
      rollouts: weights that it proposes, half of them from either subspace.
      next_weights: by which weights the next action is taken and valued in the
        critics' target: "stored" those of the transition; "redrawn" others, as in the
        authors' code, which makes the targets alike for all weights.
      candidate_score: what proposed weights are judged by: "episode", the return of
        their episodes; "since_reset", where the environment can end an episode, that
        since its latest reset, as in the authors' code.
    """

    width: int = 0
    distribution: Literal["flat", "peaked"] = "flat"
    resample_every: int = traced(100)
    improvement: float = 0.1
    samples: int = 4096
    estimations: int = 1024
    rollouts: int = 8
    next_weights: Literal["stored", "redrawn"] = "stored"
    candidate_score: CandidateScore = "episode"

    def checked(self) -> "CspSettings":
        """The settings as they are; `UserError` if they make no sense."""
        least = {"width": 0, "resample_every": 1, "estimations": 1, "rollouts": 2}
        for name, value in least.items():
            given = getattr(self, name)
            message = f"{flag(name)} must be at least {value}, not {given}"
            require(given >= value, message)
        require(
            0 <= self.improvement < math.inf,
            f"--improvement must be at least 0, not {self.improvement}",
        )
        require(self.rollouts % 2 == 0, f"--rollouts must be even, not {self.rollouts}")
        require(
            self.samples >= self.rollouts // 2,
            f"--samples {self.samples} are too few for half of "
            f"--rollouts {self.rollouts}",
        )
        return self


# Scenario: distribution, resample_every. Published with the authors' code.
_PUBLISHED: dict[str, tuple[Literal["flat", "peaked"], int]] = {
    "halfcheetah/forgetting": ("peaked", 100),
    "halfcheetah/transfer": ("peaked", 20),
    "halfcheetah/robustness": ("flat", 20),
    "halfcheetah/compositionality": ("flat", 100),
    "ant/forgetting": ("peaked", 100),
    "ant/transfer": ("peaked", 100),
    "ant/robustness": ("flat", 100),
    "ant/compositionality": ("flat", 20),
    "humanoid/hard": ("flat", 100),
}


def preset(scenario: str, period: int, profile: str) -> CspSettings:
    """Published settings or the defaults; a shorter search in the quick profile.

    The authors' search takes the mean of the values of both states of each transition.
    Twice the transitions have the same expectation.
    """
    del period
    options = CspSettings()
    if scenario.startswith("continual_world/"):
        # Its episodes have 200 steps: about as many interactions as elsewhere.
        options = CspSettings(rollouts=32)
    if scenario in _PUBLISHED:
        distribution, every = _PUBLISHED[scenario]
        options = CspSettings(distribution=distribution, resample_every=every)
    if profile == "quick":
        return dataclasses.replace(options, samples=1024, estimations=64)
    if profile == "authors":
        # On Continual World nothing ends an episode before its time.
        if not scenario.startswith("continual_world/"):
            options = dataclasses.replace(options, candidate_score="since_reset")
        return dataclasses.replace(
            options, estimations=2 * options.estimations, next_weights="redrawn"
        )
    return options


class State(NamedTuple):
    """What is kept from task to task.

    Attributes:
      learned: `[]` int32, finished tasks.
      frozen: `[]` int32, anchors kept. Slots from here on hold zeros; while a task
        is trained, the first of them stands for the newest anchor.
      anchors: layers stacked on a leading axis `[tasks]`.
      best: `[tasks, tasks]`, each finished task's weights of the anchors.
      proposals: `[rollouts, tasks]`, weights that the search found: the first half
        in the new subspace, the second in the former.
    """

    learned: jax.Array
    frozen: jax.Array
    anchors: tuple[Linear, ...]
    best: jax.Array
    proposals: jax.Array


def csp(spec: Spec, options: CspSettings) -> Method:
    """Policies are weighted means of anchors; each task may add one.

    Only the newest anchor is trained, by policies drawn from the simplex that it
    spans with the frozen ones. Labels and contexts are weights `[..., tasks]`, which
    the critics see, too. At a task's end the critics propose weights with and
    without the newest anchor; by their returns it is kept or dropped.
    """
    slots, half = spec.tasks, options.rollouts // 2
    slot = jnp.arange(slots)

    def init(key):
        params = networks.init_mlp(key, spec.sizes(options.width))
        return params, State(
            learned=jnp.zeros((), jnp.int32),
            frozen=jnp.zeros((), jnp.int32),
            anchors=tile(jax.tree.map(jnp.zeros_like, params), slots),
            best=jnp.zeros((slots, slots)),
            proposals=jnp.zeros((options.rollouts, slots)),
        )

    def from_former(key, state, shape):
        # Before there is a frozen anchor, all weight is on the first.
        return dirichlet(key, slots, jnp.maximum(state.frozen, 1), shape)

    def from_new(key, state, shape):
        anchors = state.frozen + 1
        last = anchors**2 if options.distribution == "peaked" else None
        return dirichlet(key, slots, anchors, shape, last)

    def extras(key, state, extras, steps):
        new_key, former_key = jax.random.split(key)
        in_new = jnp.arange(steps.size) < (steps.size + 1) // 2
        drawn = jnp.where(
            in_new[:, None],
            from_new(new_key, state, steps.shape),
            from_former(former_key, state, steps.shape),
        )
        if extras is None:
            return drawn
        # An episode's first step, number 0, is among these.
        due = steps % options.resample_every == 0
        return jnp.where(due[:, None], drawn, extras)

    def context(key, state, purpose, extras):
        # As in the paper, Q is that of the policy with the stored weights, now and in
        # the next state.
        redrawn = purpose == "critic" and options.next_weights == "redrawn"
        if purpose == "policy" or redrawn:
            return from_new(key, state, extras.shape[:-1])
        return extras

    def distribution(params, state, context, observation):
        newest = context[..., state.frozen, None]
        x = observation
        for index, layer in enumerate(params):
            x = networks.activate(x) if index else x
            # A layer is linear in its numbers, so that its outputs can be mixed.
            frozen = state.anchors[index]
            outputs = jnp.einsum("...i,aoi->...ao", x, frozen.weight) + frozen.bias
            mixed = jnp.sum(context[..., None] * outputs, axis=-2)
            x = mixed + newest * networks.affine(layer, x)
        return networks.gaussian(x)

    def with_newest(params, state):
        return put(state.anchors, state.frozen, params)

    def critic_input(context, observation):
        return jnp.concatenate([observation, context], axis=-1)

    def consolidate(key, params, state, task, tools):
        del task
        samples = options.samples
        new_key, former_key, key = jax.random.split(key, 3)
        weights = jnp.concatenate(
            [
                dirichlet(new_key, slots, state.frozen + 1, (samples,)),
                from_former(former_key, state, (samples,)),
            ]
        )

        def estimate(total, key):
            batch = tools.sample(key, 2 * samples)
            value, _ = tools.q(weights, batch.observation, batch.action)
            return total + value, None

        keys = jax.random.split(key, options.estimations)
        total, _ = jax.lax.scan(estimate, jnp.zeros(2 * samples), keys)
        _, top = jax.lax.top_k(total.reshape(2, samples), half)
        chosen = top + samples * jnp.arange(2)[:, None]
        return params, state._replace(proposals=weights[chosen.reshape(-1)])

    def candidates(params, state, task):
        del task
        anchors = with_newest(params, state)
        policies = jax.vmap(fold, (None, 0))(anchors, state.proposals)
        several = jnp.broadcast_to(state.frozen > 0, options.rollouts)
        return Candidates(policies, several)

    def end_task(params, state, task, selection):
        weights = jnp.where(slot == state.frozen, 1.0, 0.0)
        kept = jnp.asarray(True)
        if selection is not None:
            # A return that is not a number must not win, as it would in argmax.
            failed = jnp.isnan(selection.after)
            returns = jnp.where(failed, -jnp.inf, selection.after).reshape(2, half)
            new, former = jnp.max(returns, axis=1)
            better = new > (1 + options.improvement) * former
            first = state.frozen == 0
            kept = first | better
            winner = jnp.argmax(returns, axis=1)
            chosen = jnp.where(better, winner[0], half + winner[1])
            weights = jnp.where(first, weights, state.proposals[chosen])
        anchors = jax.tree.map(
            lambda a, b: jnp.where(kept, a, b),
            with_newest(params, state),
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

    def policy(params, state, task):
        latest = jnp.maximum(state.learned - 1, 0)
        folded = fold(state.anchors, state.best[jnp.minimum(task, latest)])
        return jax.tree.map(
            lambda a, b: jnp.where(state.learned > 0, a, b), folded, params
        )

    def size(params, state):
        # As in the authors' code, the tasks' few weights are not counted.
        return jnp.maximum(state.frozen, 1) * count(params)

    return Method(
        init=init,
        distribution=distribution,
        policy=policy,
        act=networks.mlp_policy,
        size=size,
        extras=extras,
        context=context,
        critic_input=critic_input,
        critic_extra=slots,
        fresh_critic=True,
        consolidate=consolidate,
        candidates=candidates,
        in_budget=True,
        candidate_score=options.candidate_score,
        end_task=end_task,
    )


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
      shape: of the draws.
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
