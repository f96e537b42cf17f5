"""What a continual-learning method is: a record of pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

Params = Any
"""Pytree that the policy's optimiser trains."""
Memory = Any
"""Pytree that a method carries from task to task, with its slots from the start."""
Context = Any
"""Pytree of what a method draws for one update or one acting step."""
Policy = Any
"""Pytree from which `Method.act` computes actions."""


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


class Candidates(NamedTuple):
    """Policies that a method wants rolled out on the current task.

    Attributes:
      policies: a `Policy` with a leading axis `[candidates]`.
      valid: `[candidates]` bool; the others are neither counted nor chosen.
    """

    policies: Policy
    valid: jax.Array


class Selection(NamedTuple):
    """Mean returns of a method's candidates on the task just trained.

    Attributes:
      before: `[candidates]`, when the task began.
      after: `[candidates]`, at its end.
    """

    before: jax.Array
    after: jax.Array


class Method(NamedTuple):
    """A method as pure functions of one member of a population.

    It is made by `make(spec, settings)` inside traced code, so that the settings'
    numbers may differ between the members of a population. `task` is a `[]` int,
    the index in the sequence.

    Attributes:
      init: `key -> params, memory`, before the first task.
      start_task: `(key, params, memory, task) -> params, memory`. Optimisers and
        temperature start anew by themselves.
      context: `(key, memory, learning) -> context`, drawn for each update
        (`learning`, a Python bool) and each acting step.
      distribution: `(params, memory, context, observation) -> mean, log_std` of
        the Gaussian before the squashing; observation `[..., observations]`.
      penalty: `(key, params, memory, context, observation, (mean, log_std)) ->
        loss, metrics`, added to SAC's policy loss; the pair is what
        `distribution` gave for the same arguments.
      adjust_updates: `(updates, memory) -> updates`, after the optimiser.
      candidates: `(params, memory, task) -> Candidates`, rolled out at the start
        and at the end of each task, or None where nothing is to be chosen.
      end_task: `(params, memory, task, Selection or None) -> params, memory`.
      policy: `(params, memory, task) -> policy` for a task of the sequence, after
        any number of finished tasks; one not yet seen gets the latest policy, or
        the one that the method knows to belong to it.
      act: `(policy, observation) -> mean, log_std`; a plain function, the same
        object for all members.
      size: `(params, memory) -> []`, the numbers stored for all policies.
    """

    init: Callable[[jax.Array], tuple[Params, Memory]]
    start_task: Callable[..., tuple[Params, Memory]]
    context: Callable[[jax.Array, Memory, bool], Context]
    distribution: Callable[..., tuple[jax.Array, jax.Array]]
    penalty: Callable[..., tuple[jax.Array, dict[str, jax.Array]]]
    adjust_updates: Callable[[Params, Memory], Params]
    candidates: Callable[[Params, Memory, jax.Array], Candidates] | None
    end_task: Callable[..., tuple[Params, Memory]]
    policy: Callable[[Params, Memory, jax.Array], Policy]
    act: Callable[[Policy, jax.Array], tuple[jax.Array, jax.Array]]
    size: Callable[[Params, Memory], jax.Array]


def count(tree: Any) -> int:
    """How many numbers a pytree of arrays holds."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))
