"""What a continual-learning method is: a record of pure functions."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

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


class Init(Protocol):
    """Parameters and state before the first task."""

    def __call__(self, key: jax.Array, /) -> tuple[Params, MethodState]: ...


class Distribution(Protocol):
    """Mean and log-std of the Gaussian before the squashing, `[..., actions]` each.

    It is given `[..., observations]`.
    """

    def __call__(
        self,
        params: Params,
        state: MethodState,
        context: Context,
        observation: jax.Array,
        /,
    ) -> tuple[jax.Array, jax.Array]: ...


class PolicyOf(Protocol):
    """The policy for a task, after any number of finished tasks.

    A task not yet seen gets the latest policy, or the one that the method knows to
    belong to it.
    """

    def __call__(
        self, params: Params, state: MethodState, task: jax.Array, /
    ) -> Policy: ...


class Act(Protocol):
    """What `Distribution` gives, from a policy; the same object for all members."""

    def __call__(
        self, policy: Policy, observation: jax.Array, /
    ) -> tuple[jax.Array, jax.Array]: ...


class Size(Protocol):
    """`[]`, how many numbers are stored for all policies."""

    def __call__(self, params: Params, state: MethodState, /) -> jax.Array: ...


class StartTask(Protocol):
    """Parameters and state at a task's start.

    Optimisers and temperature start anew by themselves.
    """

    def __call__(
        self, key: jax.Array, params: Params, state: MethodState, task: jax.Array, /
    ) -> tuple[Params, MethodState]: ...


class ExtrasOf(Protocol):
    """Extras `[envs, ...]` that are stored with the transitions of a step.

    `steps` `[envs]` counts those of the running episodes. `extras` are those of the
    step before, None in a task's first.
    """

    def __call__(
        self, key: jax.Array, state: MethodState, extras: Extras, steps: jax.Array, /
    ) -> Extras: ...


class ContextOf(Protocol):
    """What is drawn for an update or an acting step.

    `extras` `[batch, ...]` are those of its transitions.
    """

    def __call__(
        self, key: jax.Array, state: MethodState, purpose: Purpose, extras: Extras, /
    ) -> Context: ...


class Penalty(Protocol):
    """A loss `[]`, added to SAC's policy loss, and metrics of it by name.

    `gaussian` is what `Distribution` gave for the same arguments.
    """

    def __call__(
        self,
        key: jax.Array,
        params: Params,
        state: MethodState,
        context: Context,
        observation: jax.Array,
        gaussian: tuple[jax.Array, jax.Array],
        /,
    ) -> tuple[jax.Array, dict[str, jax.Array]]: ...


class Inspect(Protocol):
    """Metrics `[]` by name, from a batch of observations, once a progress report."""

    def __call__(
        self, params: Params, state: MethodState, observation: jax.Array, /
    ) -> dict[str, jax.Array]: ...


class AdjustUpdates(Protocol):
    """The updates of the parameters, changed after the optimiser."""

    def __call__(self, updates: Params, state: MethodState, /) -> Params: ...


class CriticInput(Protocol):
    """`[..., observations + critic_extra]`, what critics see beside the action.

    Of a stored transition its extras are given as the context.
    """

    def __call__(self, context: Context, observation: jax.Array, /) -> jax.Array: ...


class Consolidate(Protocol):
    """Parameters and state once a task's interactions are over."""

    def __call__(
        self,
        key: jax.Array,
        params: Params,
        state: MethodState,
        task: jax.Array,
        tools: Tools,
        /,
    ) -> tuple[Params, MethodState]: ...


class CandidatesOf(Protocol):
    """Policies that are rolled out at the end of a task, to choose among them."""

    def __call__(
        self, params: Params, state: MethodState, task: jax.Array, /
    ) -> Candidates: ...


class EndTask(Protocol):
    """Parameters and state after a task; the selection is None where none was made."""

    def __call__(
        self,
        params: Params,
        state: MethodState,
        task: jax.Array,
        selection: Selection | None,
        /,
    ) -> tuple[Params, MethodState]: ...


class Method(NamedTuple):
    """A method as pure functions of one member of a population.

    It is made by `make(spec, settings)` inside traced code, so that the settings'
    numbers may differ between the members of a population. `task` is a `[]` int,
    the index in the sequence. Only `init`, `distribution`, `policy`, `act` and `size`
    are required. The type of each function says what it receives and returns.

    Attributes:
      init: parameters and state before the first task.
      distribution: the policy in training, a Gaussian before the squashing.
      policy: what acts in a task, for evaluation and for users.
      act: the Gaussian of such a policy.
      size: numbers stored.
      start_task: changes parameters and state when a task starts.
      extras: data stored with each transition.
      context: random draws for an update or a step.
      penalty: a loss added to SAC's policy loss.
      inspect: metrics for progress reports.
      adjust_updates: changes the optimiser's updates.
      critic_input: what critics see besides the action.
      consolidate: changes parameters and state after a task's interactions.
      candidates: policies to choose from at a task's end.
      end_task: changes parameters and state at a task's end.
      critic_extra: numbers in `critic_input` beyond the observation.
      fresh_critic: whether the critics, too, start anew with each task.
      offline: updates from the buffer after `consolidate`, which they need, a share of
        the interactions. They begin with fresh optimisers and temperature.
      offline_sac: SAC's settings for these, from those of the run.
      baseline: whether candidates are rolled out at a task's start, too.
      in_budget: whether these interactions are part of the task's own.
      candidate_score: what a candidate is judged by: the return of its "episode", or,
        after as many steps as an episode has, that "since_reset", the latest reset.
    """

    init: Init
    distribution: Distribution
    policy: PolicyOf
    act: Act
    size: Size
    start_task: StartTask = lambda key, params, state, task: (params, state)
    extras: ExtrasOf = lambda *_: ()
    context: ContextOf = lambda *_: ()
    penalty: Penalty = lambda *_: (jnp.zeros(()), {})
    inspect: Inspect = lambda *_: {}
    adjust_updates: AdjustUpdates = lambda updates, state: updates
    critic_input: CriticInput = lambda context, observation: observation
    critic_extra: int = 0
    fresh_critic: bool = False
    consolidate: Consolidate | None = None
    offline: float = 0.0
    offline_sac: Callable[[SacSettings], SacSettings] = lambda sac: sac
    candidates: CandidatesOf | None = None
    baseline: bool = False
    in_budget: bool = False
    candidate_score: CandidateScore = "episode"
    end_task: EndTask = lambda params, state, task, selection: (params, state)


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
