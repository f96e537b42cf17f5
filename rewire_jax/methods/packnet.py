"""PackNet: each task keeps a share of one network's weights (arXiv 1711.05769)."""

import dataclasses
import math
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from rewire_jax.core.arguments import require
from rewire_jax.core.pytrees import count
from rewire_jax.core.settings import settings, static
from rewire_jax.methods.base import Method
from rewire_jax.methods.finetune import FinetuneSettings, ft1
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks

FREE = -1
"""Owner of the weights that no task has kept."""


@settings
class PackNetSettings:
    """PackNet.

    Attributes:
      keep: share of each layer's weights, and of its biases, that a task keeps,
        rounded up. After at most 1 / keep tasks the network is full: later tasks train
        nothing and use the weights of the earlier tasks.
      finetune: number of updates of the kept weights after the pruning, divided by the
        task's interactions.
      finetune_targets: which of these updates also update the target critics. "delay":
        as often as in training. "nested": only those that also update the policy, as in
        the authors' code.
    """

    keep: float = 0.125
    finetune: float = static(0.1)
    finetune_targets: Literal["delay", "nested"] = "delay"

    def checked(self) -> "PackNetSettings":
        """Returns the settings; `UserError` if one is invalid."""
        require(0 < self.keep <= 1, f"--keep must lie in (0, 1], not {self.keep}")
        require(
            0 <= self.finetune < jnp.inf,
            f"--finetune must be at least 0, not {self.finetune}",
        )
        return self


def preset(scenario: str, period: int, profile: str) -> PackNetSettings:
    """Published settings, with weights left for every task of a round.

    Published are 12.5% for each task, and 100,000 updates after 1M interactions or,
    on Humanoid, 2M.
    """
    return PackNetSettings(
        finetune_targets="nested" if profile == "authors" else "delay",
        keep=min(0.125, 1 / period),
        finetune=0.05 if scenario == "humanoid/hard" else 0.1,
    )


class State(NamedTuple):
    """The owners of the weights.

    Attributes:
      learned: `[]` number of finished tasks.
      owners: for every weight and bias, the task that keeps it, or `FREE`.
      trained: `[]` owner of the weights that updates change: `FREE` until the
        pruning, then the task.
    """

    learned: jax.Array
    owners: Any
    trained: jax.Array


def packnet(spec: Spec, options: PackNetSettings) -> Method:
    """A task trains the free weights, prunes them, and finetunes those it keeps."""

    def init(key):
        params = networks.init_mlp(key, spec.sizes())
        owners = jax.tree.map(lambda x: jnp.full(x.shape, FREE, jnp.int32), params)
        return params, State(
            learned=jnp.zeros((), jnp.int32),
            owners=owners,
            trained=jnp.full((), FREE, jnp.int32),
        )

    def adjust_updates(updates, state):
        return jax.tree.map(
            lambda update, owner: jnp.where(owner == state.trained, update, 0.0),
            updates,
            state.owners,
        )

    def consolidate(key, params, state, task, tools):
        del key, tools
        owners = jax.tree.map(
            lambda x, owner: jnp.where(
                largest(x, owner == FREE, options.keep), task, owner
            ),
            params,
            state.owners,
        )
        # Pruned weights are 0 at the start of the next task.
        params = jax.tree.map(
            lambda x, owner: jnp.where(owner == FREE, 0.0, x), params, owners
        )
        trained = jnp.full_like(state.trained, task)
        return params, state._replace(owners=owners, trained=trained)

    def offline_sac(sac):
        if options.finetune_targets == "delay":
            return sac
        both = math.lcm(sac.policy_delay, sac.target_delay)
        return dataclasses.replace(sac, target_delay=both)

    def end_task(params, state, task, selection):
        del task, selection
        return params, state._replace(
            learned=state.learned + 1, trained=jnp.full_like(state.trained, FREE)
        )

    def policy(params, state, task):
        # A task that was not trained yet gets all weights. Those without an owner are
        # zeros or, before the first task, the initial weights.
        def part(x, owner):
            kept = (owner != FREE) & (owner <= task)
            return jnp.where(kept | (task >= state.learned), x, 0.0)

        return jax.tree.map(part, params, state.owners)

    return ft1(spec, FinetuneSettings())._replace(
        init=init,
        policy=policy,
        size=lambda params, state: jnp.asarray(count(params) + count(state.owners)),
        redo_policy=False,
        adjust_updates=adjust_updates,
        consolidate=consolidate,
        offline=options.finetune,
        offline_sac=offline_sac,
        end_task=end_task,
    )


def largest(x: jax.Array, free: jax.Array, keep: ArrayLike) -> jax.Array:
    """Mask of the free entries of largest magnitude.

    Args:
      x: array of any shape.
      free: bool, of its shape.
      keep: share of all entries to choose, rounded up; at most all free entries. Of
        equal magnitudes the first are chosen.
    """
    magnitude = jnp.where(free, jnp.abs(x), -1.0).ravel()
    ranks = jnp.argsort(jnp.argsort(magnitude, descending=True))
    return free & (ranks < jnp.ceil(keep * x.size)).reshape(x.shape)
