"""Acting by what was learned, without exploration."""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from rewire_jax.methods.base import Method, Policy
from rewire_jax.methods.spec import Spec


class Learned(NamedTuple):
    """Everything that a member has learned; it determines the member's policies.

    Attributes:
      params: the parameters of its method.
      method_state: what its method carries from task to task; for `rewire`, among
        others `orders` `[slots, L, n]`, the cached wirings.
    """

    params: Any
    method_state: Any


Act = Callable[[Learned, jax.Array | int, jax.Array], jax.Array]
"""`(learned, task, observation) -> action`: a `[]` int and `[..., observations]` to
`[..., actions]` in [-1, 1]."""


def mean_action(
    method: Method, spec: Spec, policy: Policy, observation: jax.Array
) -> jax.Array:
    """A policy's action `[..., actions]` in [-1, 1] for `[..., observations]`.

    Raises:
      AssertionError: an observation of another length than the method was made for.
    """
    observation = jnp.asarray(observation)
    chex.assert_axis_dimension(observation, -1, spec.observations)
    mean, _ = method.act(policy, observation)
    return jnp.tanh(mean)


def _check_task(task: Any, tasks: int) -> None:
    """Raises `ValueError` if this is no place of a task."""
    try:
        place = -1 if isinstance(task, bool) else operator.index(task)
    except TypeError:
        place = -1
    if not 0 <= place < tasks:
        raise ValueError(f"task must be 0 to {tasks - 1}, not {task}")


def act_function(method: Method, spec: Spec) -> Act:
    """How to act by what a method, made from this spec, has learned."""
    like = Learned(*jax.eval_shape(method.init, jax.random.key(0)))

    def act(
        learned: Learned, task: jax.Array | int, observation: jax.Array
    ) -> jax.Array:
        if not isinstance(task, jax.core.Tracer):
            _check_task(task, spec.tasks)
        chex.assert_trees_all_equal_shapes(learned, like)
        policy = method.policy(learned.params, learned.method_state, jnp.asarray(task))
        return mean_action(method, spec, policy, observation)

    return act
