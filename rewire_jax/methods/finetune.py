"""FT-1: one policy, finetuned from task to task."""

import jax.numpy as jnp

from rewire_jax import networks
from rewire_jax.config import settings
from rewire_jax.methods.base import Method, Spec, count


@settings
class Ft1Settings:
    """FT-1 has no settings of its own."""

    def checked(self) -> "Ft1Settings":
        """The settings as they are."""
        return self


def preset(scenario: str, period: int, profile: str) -> Ft1Settings:
    """The settings for every scenario and profile."""
    del scenario, period, profile
    return Ft1Settings()


def ft1(spec: Spec, options: Ft1Settings) -> Method:
    """The policy of the latest task is the policy of all tasks."""
    del options
    sizes = [spec.observations, *[spec.hidden] * spec.depth, 2 * spec.actions]

    def init(key):
        return networks.init_mlp(key, sizes), ()

    return Method(
        init=init,
        start_task=lambda key, params, memory, task: (params, memory),
        context=lambda key, memory, learning: (),
        distribution=lambda params, memory, context, observation: networks.mlp_policy(
            params, observation
        ),
        penalty=lambda *_: (jnp.zeros(()), {}),
        adjust_updates=lambda updates, memory: updates,
        candidates=None,
        end_task=lambda params, memory, task, selection: (params, memory),
        policy=lambda params, memory, task: params,
        act=networks.mlp_policy,
        size=lambda params, memory: jnp.asarray(count(params)),
    )
