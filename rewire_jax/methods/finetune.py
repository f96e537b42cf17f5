"""Plain policies: one finetuned (FT-1), every one kept (FT-N), all fresh (SAC-N)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core.pytrees import at, count, put, tile
from rewire_jax.core.settings import settings
from rewire_jax.methods.base import Method
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks


@settings
class FinetuneSettings:
    """FT-1, FT-N and SAC-N have no settings of their own."""

    def checked(self) -> "FinetuneSettings":
        """The settings as they are."""
        return self


def preset(scenario: str, period: int, profile: str) -> FinetuneSettings:
    """The settings for every scenario and profile."""
    del scenario, period, profile
    return FinetuneSettings()


class Kept(NamedTuple):
    """The policies of finished tasks.

    Attributes:
      learned: `[]` int32, how many there are.
      policies: layers, stacked on a leading axis `[tasks]`.
    """

    learned: jax.Array
    policies: tuple[networks.Linear, ...]


def ft1(spec: Spec, options: FinetuneSettings) -> Method:
    """The policy of the latest task is the policy of all tasks."""
    del options
    act = networks.policy_of(spec.network)
    return Method(
        init=lambda key: (networks.init_mlp(key, spec.sizes()), ()),
        distribution=lambda params, state, context, observation: act(
            params, observation
        ),
        policy=lambda params, state, task: params,
        act=act,
        size=lambda params, state: jnp.asarray(count(params)),
        hidden=lambda params, state, observation: networks.hidden_of(spec.network)(
            params, observation
        ),
        redo_policy=True,
    )


def ft_n(spec: Spec, options: FinetuneSettings) -> Method:
    """Each task's policy starts as a copy of the last one's, and is kept."""
    plain = ft1(spec, options)

    def init(key):
        params, _ = plain.init(key)
        return params, Kept(jnp.zeros((), jnp.int32), tile(params, spec.tasks))

    def end_task(params, state, task, selection):
        del selection
        return params, Kept(state.learned + 1, put(state.policies, task, params))

    def policy(params, state, task):
        finished = task < state.learned
        own = at(state.policies, task)
        return jax.tree.map(lambda a, b: jnp.where(finished, a, b), own, params)

    return plain._replace(
        init=init,
        end_task=end_task,
        policy=policy,
        size=lambda params, state: jnp.maximum(state.learned, 1) * count(params),
    )


def sac_n(spec: Spec, options: FinetuneSettings) -> Method:
    """Each task's policy starts from fresh weights, and is kept."""
    plain = ft_n(spec, options)

    def start_task(key, params, state, task):
        del params, task
        return plain.init(key)[0], state

    return plain._replace(start_task=start_task)
