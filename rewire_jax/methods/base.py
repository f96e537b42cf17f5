"""What a continual-learning method is: a record of pure functions."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from rewire_jax.core.settings import SacSettings
from rewire_jax.core.transition import Batch
from rewire_jax.methods.round import Round

Params = Any
"""Pytree that the policy's optimiser trains."""
MethodState = Any
"""Pytree that a method carries from task to task. Its shapes never change."""
Extras = Any
"""Pytree that a method stores with each transition."""
Context = Any
"""Pytree that a method draws at random for one update or one acting step."""
Policy = Any
"""Pytree from which `Method.act` computes actions; parts of it may be `Shared`."""
CandidateScore = Literal["episode", "since_reset"]
Purpose = Literal["act", "critic", "policy"]
"""The use of a context: an acting step, or an update of the critics or the policy."""


class Tools(NamedTuple):
    """Functions that `Consolidate` may call.

    Attributes:
      sample: `(key, count) -> Batch`, draws `[count]` transitions of the task.
      q: `(context, observation, action) -> [2, count]`, values from both critics.
    """

    sample: Callable[[jax.Array, int], Batch]
    q: Callable[[Context, jax.Array, jax.Array], jax.Array]


class Candidates(NamedTuple):
    """Policies among which a method chooses by their return on the current task.

    Attributes:
      policies: a `Policy` with a leading axis `[candidates]`.
      valid: `[candidates]` bool; the others are neither counted nor to be chosen.
    """

    policies: Policy
    valid: jax.Array


class Selection(NamedTuple):
    """Mean returns of a method's candidates; all are 0 if no candidate was valid.

    Attributes:
      before: `[candidates]`, at the task's start; None without `Method.baseline`.
      after: `[candidates]`, at the task's end.
    """

    before: jax.Array | None
    after: jax.Array

    @property
    def ranked(self) -> jax.Array:
        """`after` with -inf for NaN, which argmax would choose."""
        return jnp.where(jnp.isnan(self.after), -jnp.inf, self.after)


class Init(Protocol):
    """Returns parameters and state; called once, before the first task."""

    def __call__(self, key: jax.Array, /) -> tuple[Params, MethodState]: ...


class Distribution(Protocol):
    """Returns mean and log-std before the tanh; called in each acting step and update.

    They are `[..., actions]` each, for observations `[..., observations]`.
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
    """Returns the policy for a task; called for all tasks before each evaluation.

    A task not yet trained gets the latest policy, or one known to belong to it.
    """

    def __call__(
        self, params: Params, state: MethodState, task: jax.Array, /
    ) -> Policy: ...


class Act(Protocol):
    """Returns mean and log-std of a `Policy`; called in each step of an evaluation.

    It must be the same function object each time the method is made, because compiled
    evaluations are cached by it.
    """

    def __call__(
        self, policy: Policy, observation: jax.Array, /
    ) -> tuple[jax.Array, jax.Array]: ...


class Size(Protocol):
    """Returns `[]`, how many numbers are stored; called at each evaluation.

    Not only policies count: rewire and EWC also count previous weights. Stored states,
    and what is stored with them, count in `Method.stored` instead.
    """

    def __call__(self, params: Params, state: MethodState, /) -> jax.Array: ...


class StartTask(Protocol):
    """Changes parameters and state; called at the start of each task.

    The loop itself resets the optimisers, the temperature and the target critics.
    """

    def __call__(
        self, key: jax.Array, params: Params, state: MethodState, task: jax.Array, /
    ) -> tuple[Params, MethodState]: ...


class ExtrasOf(Protocol):
    """Returns extras `[envs, ...]`, stored with the step; called in each acting step.

    `steps` `[envs]` counts the steps made in the running episodes. `extras` is the
    result of the previous call. At a task's start there is one extra call with None.
    Its result is not stored: it is passed to the call for the first step.
    """

    def __call__(
        self, key: jax.Array, state: MethodState, extras: Extras, steps: jax.Array, /
    ) -> Extras: ...


class ContextOf(Protocol):
    """Returns a random draw, for an acting step or an update; called for each of them.

    An update calls it for the critics and for the policy. `extras` `[batch, ...]` are
    those of the same transitions.
    """

    def __call__(
        self, key: jax.Array, state: MethodState, purpose: Purpose, extras: Extras, /
    ) -> Context: ...


class Penalty(Protocol):
    """Returns a loss `[]` and metrics by name; called in each update of the policy.

    The loss is added to SAC's policy loss. `gaussian` is what `Distribution` returned
    for the same arguments.
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
    """Returns metrics `[]` from `[batch]` observations; called for each report."""

    def __call__(
        self, params: Params, state: MethodState, observation: jax.Array, /
    ) -> dict[str, jax.Array]: ...


class AdjustGradient(Protocol):
    """Changes the gradient of the policy's loss; called before the optimiser."""

    def __call__(self, gradient: Params, state: MethodState, /) -> Params: ...


class Hidden(Protocol):
    """Returns the policy's activations `[batch, n]` in each hidden layer.

    It is the policy in training, on `[batch]` observations. Called for each report with
    `--plasticity-metrics`.
    """

    def __call__(
        self, params: Params, state: MethodState, observation: jax.Array, /
    ) -> list[jax.Array]: ...


class AdjustUpdates(Protocol):
    """Changes what will be added to the parameters; called after the optimiser."""

    def __call__(self, updates: Params, state: MethodState, /) -> Params: ...


class AfterRound(Protocol):
    """Changes parameters and state; called after each round of updates.

    The optimiser's state stays as it is.
    """

    def __call__(
        self, params: Params, state: MethodState, made: Round, /
    ) -> tuple[Params, MethodState]: ...


class CriticInput(Protocol):
    """Returns the critics' input besides the action; called at each of their uses.

    It is `[..., observations + critic_extra]`. For stored actions, `context` is the
    extras stored with them.
    """

    def __call__(self, context: Context, observation: jax.Array, /) -> jax.Array: ...


class Consolidate(Protocol):
    """Changes parameters and state; called after the last interaction of each task.

    The offline updates and the candidates' evaluation come later.
    """

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
    """Returns policies to choose from; called after a task (`baseline`: and before)."""

    def __call__(
        self, params: Params, state: MethodState, task: jax.Array, /
    ) -> Candidates: ...


class AfterBaseline(Protocol):
    """Changes parameters and state; called after the evaluation of `Method.baseline`.

    `before` is that of `Selection`. If `selection_episodes` is 0, it is not called.
    """

    def __call__(
        self, params: Params, state: MethodState, before: jax.Array, /
    ) -> tuple[Params, MethodState]: ...


class EndTask(Protocol):
    """Changes parameters and state; called after the candidates' evaluation.

    `selection` is None if the method has no candidates or `selection_episodes` is 0.
    """

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

    A population is all members that one program trains; a member is one configuration
    with one seed. The loop calls `make(spec, settings)` in traced code, so that numeric
    settings may differ between members. `task` is a `[]` int, an index in the sequence.

    Only `init`, `distribution`, `policy`, `act` and `size` are required. The type of
    each function says when the loop calls it. The loop itself reads the other fields.

    Attributes:
      stored: how many numbers of stored states there are, see `Size`.
      redo_policy: whether `--redo-every` also resets neurons of the policy. It requires
        `hidden`, and parameters that are the layers of one plain policy.
      critic_extra: length of the critics' input besides observation and action.
      fresh_critic: whether each task starts with newly initialised critics.
      offline: updates after `consolidate`, divided by the task's interactions. They
        require `consolidate`, after which optimisers and temperature are reset again.
      offline_sac: SAC's settings in these updates, computed from those of the run.
      baseline: whether candidates are also evaluated at the start of each task.
      in_budget: whether the candidates' steps are taken from the task's budget.
      candidate_score: "episode": the return of an episode; "since_reset": the return
        since the latest reset, of `episode_length - 1` steps that continue after a
        terminal state.
    """

    init: Init
    distribution: Distribution
    policy: PolicyOf
    act: Act
    size: Size
    stored: Size = lambda params, state: jnp.zeros((), jnp.int32)
    start_task: StartTask = lambda key, params, state, task: (params, state)
    extras: ExtrasOf = lambda *_: ()
    context: ContextOf = lambda *_: ()
    penalty: Penalty = lambda *_: (jnp.zeros(()), {})
    inspect: Inspect = lambda *_: {}
    adjust_gradient: AdjustGradient = lambda gradient, state: gradient
    hidden: Hidden | None = None
    redo_policy: bool = False
    adjust_updates: AdjustUpdates = lambda updates, state: updates
    after_round: AfterRound = lambda params, state, made: (params, state)
    critic_input: CriticInput = lambda context, observation: observation
    critic_extra: int = 0
    fresh_critic: bool = False
    consolidate: Consolidate | None = None
    offline: float = 0.0
    offline_sac: Callable[[SacSettings], SacSettings] = lambda sac: sac
    candidates: CandidatesOf | None = None
    baseline: bool = False
    after_baseline: AfterBaseline | None = None
    in_budget: bool = False
    candidate_score: CandidateScore = "episode"
    end_task: EndTask = lambda params, state, task, selection: (params, state)
