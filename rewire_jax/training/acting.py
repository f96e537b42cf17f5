"""Acting by what was learned, without exploration."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.methods.base import Method, Policy


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


def mean_action(method: Method, policy: Policy, observation: jax.Array) -> jax.Array:
    """`[..., actions]` in [-1, 1], that of a policy for `[..., observations]`."""
    mean, _ = method.act(policy, observation)
    return jnp.tanh(mean)


def act_function(method: Method) -> Act:
    """How to act by what a method has learned."""

    def act(
        learned: Learned, task: jax.Array | int, observation: jax.Array
    ) -> jax.Array:
        policy = method.policy(learned.params, learned.method_state, jnp.asarray(task))
        return mean_action(method, policy, observation)

    return act
