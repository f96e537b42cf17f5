"""What a continual-learning method is: a record of pure functions."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core.settings import SacSettings
from rewire_jax.core.transition import Batch

Params = Any
"""Pytree that the policy's optimiser trains."""
MethodState = Any
"""Pytree that a method carries from task to task, with its slots from the start."""
Extras = Any
"""Pytree that a method stores with each transition."""
Context = Any
"""Pytree of what a method draws for one update or one acting step."""
Policy = Any
"""Pytree from which `Method.act` computes actions; parts of it may be `Shared`."""
CandidateScore = Literal["episode", "since_reset"]
Purpose = Literal["act", "critic", "policy"]
"""What a context is drawn for, which is a step or an update of critics or policy."""


class Spec(NamedTuple):
    """Static sizes a method builds its arrays from.

    Attributes:
      observations: length of an observation.
      actions: length of an action.
      hidden: neurons in each hidden layer.
      depth: number of hidden layers.
      tasks: length of the task sequence.
    """

    observations: int
    actions: int
    hidden: int
    depth: int
    tasks: int

    def sizes(self, width: int = 0) -> list[int]:
        """Layer sizes of a plain policy; `width` 0 stands for `hidden`."""
        hidden = [width or self.hidden] * self.depth
        return [self.observations, *hidden, 2 * self.actions]


class Tools(NamedTuple):
    """What a method may use at the end of a task's interactions.

    Attributes:
      sample: `(key, count) -> Batch`, `[count]` transitions of the task.
      q: `(context, observation, action) -> [2, count]`, both critics' values of
        `[count, ...]` observations and actions.
    """

    sample: Callable[[jax.Array, int], Batch]
    q: Callable[[Context, jax.Array, jax.Array], jax.Array]


class Candidates(NamedTuple):
    """Policies that a method wants rolled out on the current task.

    Attributes:
      policies: a `Policy` with a leading axis `[candidates]`.
      valid: `[candidates]` bool; the others are neither counted nor chosen.
    """

    policies: Policy
    valid: jax.Array


class Shared(NamedTuple):
    """A part that is the same in all of a member's policies, and stored once."""

    value: Any


def map_own(function: Callable[[jax.Array], Any], policies: Any) -> Any:
    """Maps the arrays of stacked policies, but for what they share."""
    return jax.tree.map(
        lambda x: x if isinstance(x, Shared) else function(x), policies, is_leaf=_shared
    )


def axes(policies: Any) -> Any:
    """For `vmap` over stacked policies: 0, but None for what they share."""
    return jax.tree.map(
        lambda x: None if isinstance(x, Shared) else 0, policies, is_leaf=_shared
    )


def _shared(part: Any) -> bool:
    return isinstance(part, Shared)


class Selection(NamedTuple):
    """Mean returns of a method's candidates on the task just trained.

    Attributes:
      before: `[candidates]`, when the task began; None without `Method.baseline`.
      after: `[candidates]`, at its end.
    """

    before: jax.Array | None
    after: jax.Array


class Method(NamedTuple):
    """A method as pure functions of one member of a population.

    It is made by `make(spec, settings)` inside traced code, so that the settings'
    numbers may differ between the members of a population. `task` is a `[]` int,
    the index in the sequence. Only the first five are needed.

    Attributes:
      init: `key -> params, state`, before the first task.
      distribution: `(params, state, context, observation) -> mean, log_std` of
        the Gaussian before the squashing; observation `[..., observations]`.
      policy: `(params, state, task) -> policy` for a task of the sequence, after
        any number of finished tasks; one not yet seen gets the latest policy, or
        the one that the method knows to belong to it.
      act: `(policy, observation) -> mean, log_std`; a plain function, the same
        object for all members.
      size: `(params, state) -> []`, the numbers stored for all policies.
      start_task: `(key, params, state, task) -> params, state`. Optimisers and
        temperature start anew by themselves.
      extras: `(key, state, extras, steps) -> extras [envs, ...]`, stored with the
        transitions of a step. `steps` `[envs]` counts those of the running
        episodes; `extras` is that of the step before, None in a task's first.
      context: `(key, state, purpose, extras) -> context`, drawn for each update
        and each acting step; `extras` `[batch, ...]` is that of the transitions.
      penalty: `(key, params, state, context, observation, (mean, log_std)) ->
        loss, metrics`, added to SAC's policy loss; the pair is what
        `distribution` gave for the same arguments.
      inspect: `(params, state, observation) -> metrics`, computed from a batch once
        a progress report.
      adjust_updates: `(updates, state) -> updates`, after the optimiser.
      critic_input: `(context, observation) -> [..., observations + critic_extra]`,
        what the critics see beside the action; of a stored transition its extras are
        given as the context.
      critic_extra: numbers in it beyond the observation.
      fresh_critic: whether the critics, too, start anew with each task.
      consolidate: `(key, params, state, task, tools) -> params, state`, when a
        task's interactions are over; or None.
      offline: updates from the buffer after that, a share of the interactions. They
        begin with fresh optimisers and temperature, and need `consolidate`.
      offline_sac: SAC's settings for these, from those of the run.
      candidates: `(params, state, task) -> Candidates`, rolled out at the end of
        each task, or None where nothing is to be chosen.
      baseline: whether they are rolled out at a task's start, too.
      in_budget: whether these interactions are part of the task's own.
      candidate_score: what a candidate is judged by: the return of its "episode", or,
        after as many steps as an episode has, that "since_reset", the latest reset.
      end_task: `(params, state, task, Selection or None) -> params, state`.
    """

    init: Callable[[jax.Array], tuple[Params, MethodState]]
    distribution: Callable[..., tuple[jax.Array, jax.Array]]
    policy: Callable[[Params, MethodState, jax.Array], Policy]
    act: Callable[[Policy, jax.Array], tuple[jax.Array, jax.Array]]
    size: Callable[[Params, MethodState], jax.Array]
    start_task: Callable[..., tuple[Params, MethodState]] = (
        lambda key, params, state, task: (params, state)
    )
    extras: Callable[..., Extras] = lambda *_: ()
    context: Callable[..., Context] = lambda *_: ()
    penalty: Callable[..., tuple[jax.Array, dict[str, jax.Array]]] = lambda *_: (
        jnp.zeros(()),
        {},
    )
    inspect: Callable[[Params, MethodState, jax.Array], dict[str, jax.Array]] = (
        lambda *_: {}
    )
    adjust_updates: Callable[[Params, MethodState], Params] = lambda updates, state: (
        updates
    )
    critic_input: Callable[[Context, jax.Array], jax.Array] = (
        lambda context, observation: observation
    )
    critic_extra: int = 0
    fresh_critic: bool = False
    consolidate: Callable[..., tuple[Params, MethodState]] | None = None
    offline: float = 0.0
    offline_sac: Callable[[SacSettings], SacSettings] = lambda sac: sac
    candidates: Callable[[Params, MethodState, jax.Array], Candidates] | None = None
    baseline: bool = False
    in_budget: bool = False
    candidate_score: CandidateScore = "episode"
    end_task: Callable[..., tuple[Params, MethodState]] = (
        lambda params, state, task, selection: (params, state)
    )


def count(tree: Any) -> int:
    """How many numbers a pytree of arrays holds."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def tile(tree: Any, copies: int) -> Any:
    """Copies of a pytree's arrays, stacked on a new leading axis."""
    return jax.tree.map(lambda x: jnp.tile(x, (copies, *[1] * x.ndim)), tree)


def at(tree: Any, index: jax.Array) -> Any:
    """The entries of a stacked pytree at an index."""
    return jax.tree.map(lambda x: x[index], tree)


def put(tree: Any, index: jax.Array, value: Any) -> Any:
    """A stacked pytree with the entries at an index replaced."""
    return jax.tree.map(lambda x, v: x.at[index].set(v), tree, value)
