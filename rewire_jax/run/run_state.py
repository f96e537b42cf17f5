"""The state of a run."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.training import population
from rewire_jax.training.loop_state import RunnerState
from rewire_jax.training.run_setup import Plan
from rewire_jax.training.sac import TrainState


class Segment(NamedTuple):
    """What a learner that is not told the tasks takes for the current task.

    Attributes:
      number: number of the segment, from 0.
      offset: added to the vector steps in the current task, it gives those in the
        segment; negative if the segment began in this task.
      scores: latest scores of `change_detection.surprise` in it, oldest first.
    """

    number: int
    offset: int
    scores: tuple[float, ...]


class RunState(NamedTuple):
    """The state of a run; between tasks `steps` is 0.

    Between tasks `state` is None, unless the learner is not told the tasks: then it
    goes on from `state`, and `learner` is what it would be if its task ended here.

    Attributes:
      stage: the task being trained, or to be trained next.
      steps: vector steps made in it, and then rounds of offline updates.
      learner: between tasks, the learner.
      state: within a task, the learner and all else.
      before: within a task, the candidates' returns at its start, or None.
      active: `[members]` bool on the host, False for members no longer updated.
      selection: `[members]` int, interactions spent on candidates so far.
      segment: with `--boundaries detected` the segment, after the start of a task.
    """

    stage: int
    steps: int
    learner: TrainState | None
    state: RunnerState | None
    before: jax.Array | None
    active: np.ndarray
    selection: jax.Array
    segment: Segment | None = None

    @property
    def segment_number(self) -> int:
        """Number of what the learner takes for the current task."""
        return self.segment.number if self.segment else self.stage

    @property
    def segment_time(self) -> int:
        """Vector steps made in what the learner takes for the current task."""
        return self.steps + (self.segment.offset if self.segment else 0)


def start(plan: Plan) -> RunState:
    """Returns the state before the first task."""
    return RunState(
        stage=0,
        steps=0,
        learner=plan.program.init(plan.stacked),
        state=None,
        before=None,
        active=np.ones(plan.num_slots, bool),
        selection=jnp.zeros(plan.num_slots, jnp.int32),
    )


def interactions(standing: RunState, plan: Plan) -> int:
    """Returns the training interactions of each member, in all tasks."""
    steps = min(standing.steps, plan.budget.steps)
    return standing.stage * plan.interactions + steps * plan.settings.envs


def between(stage: int, items: dict[str, Any], plan: Plan) -> RunState:
    """The standing before a task, from what is kept after the one before."""
    items = population.place(items, plan.mesh)
    params, method_state = items["policy"]
    return RunState(
        stage=stage,
        steps=0,
        # The rest of a learner is reset at the start of the next task.
        learner=plan.program.init(plan.stacked)._replace(
            params=params, method_state=method_state, critic=items["critic"]
        ),
        state=None,
        before=None,
        active=np.asarray(items["counts"]["active"]),
        selection=items["counts"]["selection"],
    )
