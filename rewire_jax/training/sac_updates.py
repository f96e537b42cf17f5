"""A round of updates in one compiled loop, for one member.

Updates of the policy and of the targets are delayed. If an update decides about this as
it runs, this is a branch, and at each branch a GPU waits for the host. So a GPU makes
updates in groups. Everything is due at the first update of a group, so what is due at
the others is known when they are compiled.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from rewire_jax.core.settings import SacSettings
from rewire_jax.core.transition import Batch
from rewire_jax.methods.base import Method
from rewire_jax.training import sac
from rewire_jax.training.sac import Metrics, TrainState, UpdateNoise

_LARGEST = 4  # the least common multiple of the published delays


def group_size(count: int, settings: SacSettings) -> int:
    """Returns the size of the groups in rounds of `count` updates; 1 for no groups.

    A CPU does not wait at a branch. There, groups take longer to compile, and change
    results by rounding, because XLA fuses other operations.
    """
    if jax.default_backend() == "cpu":
        return 1
    group = math.lcm(settings.policy_delay, settings.target_delay)
    return group if group <= _LARGEST and count % group == 0 else 1


def updates(
    learner: TrainState,
    draws: UpdateNoise,
    batch: Callable[[jax.Array], Batch],
    before: jax.Array | int,
    count: jax.Array | int,
    method: Method,
    settings: SacSettings,
    group: int,
) -> tuple[TrainState, Metrics]:
    """Makes several updates; also returns the metrics of the last one.

    Args:
      learner: the member's learner.
      draws: `[count]` or more on every leaf.
      batch: `number -> Batch`, the transitions of an update.
      before: `[]` int, updates made before in this task, a multiple of the group;
        shared by all members, see `sac.update`.
      count: `[]` int, number of updates to make, a multiple of the group.
      method: the method.
      settings: SAC's settings.
      group: 1, or a multiple of both delays, see `group_size`.
    """

    def one(number, before, carry):
        learner, metrics = carry
        draw = jax.tree.map(lambda x: x[number], draws)
        return sac.update(
            learner, metrics, batch(number), draw, before, method, settings
        )

    def several(index, carry):
        for place in range(group):
            carry = one(group * index + place, place, carry)
        return carry

    draw = jax.tree.map(lambda x: x[0], draws)
    metrics = sac.first_metrics(learner, batch(jnp.asarray(0)), draw, method, settings)
    if group > 1:
        return jax.lax.fori_loop(0, count // group, several, (learner, metrics))
    return jax.lax.fori_loop(
        0,
        count,
        lambda number, carry: one(number, before + number, carry),
        (learner, metrics),
    )
