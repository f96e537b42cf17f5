"""A time that training takes at least, from the sizes of its networks."""

import os

import jax

from rewire_jax.core.pytrees import count
from rewire_jax.training.run_setup import Plan

_CORE, _ACCELERATOR = 1e11, 1e15  # multiplications a second that none exceeds
_PASSES = 3  # through a network in an update: forward, and backward twice as long


def least_hours(plan: Plan, members: int) -> float:
    """Hours for the updates of so many members; steps of environments come on top.

    Args:
      plan: plan of any of them.
      members: their number.
    """
    settings, budget = plan.settings, plan.budget
    learner = jax.eval_shape(plan.program.init, plan.stacked)
    numbers = count((learner.params, learner.critic)) / plan.num_slots
    rounds = settings.tasks * (budget.steps - settings.warmup / settings.envs)
    updates = settings.updates * rounds / settings.update_every
    work = members * updates * settings.sac.batch_size * numbers * _PASSES
    devices = jax.local_devices()
    on_cpu = devices[0].platform == "cpu"
    cores = _CORE * (os.cpu_count() or 1)
    return work / (cores if on_cpu else _ACCELERATOR * len(devices)) / 3600
