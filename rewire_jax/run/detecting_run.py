"""A run whose learner is not told when the task changes (`--boundaries detected`)."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.envs.base import Task
from rewire_jax.methods import segments
from rewire_jax.run.run_loop import Run
from rewire_jax.run.run_state import RunState, Segment
from rewire_jax.training import change_detection, population
from rewire_jax.training.run_setup import chunk_steps
from rewire_jax.training.sac import TrainState


class DetectingRun(Run):
    """A run of one member that learns segments: what lies between noticed changes.

    The tasks change as in other runs, but only the environments are told. After each
    task the policies are evaluated as if the running segment ended there; it goes on.
    """

    @property
    def end(self) -> int:
        """See `Run`; offline updates are made where a segment ends."""
        return self.plan.budget.steps

    def begin(self, now: RunState, task: Task) -> RunState:
        """Starts the first segment, or changes the task of the environments."""
        program, members = self.plan.program, self.plan.stacked
        if now.segment:
            state = program.change_task(
                members, now.state, now.stage, now.segment_time, task
            )
            return now._replace(learner=None, state=state)
        state = program.begin(members, now.learner, now.active, 0, task)
        return now._replace(learner=None, state=state, segment=Segment(0, 0, ()))

    def after_chunk(self, now: RunState) -> tuple[RunState, dict[str, np.ndarray]]:
        """Starts a new segment if the chunk does not fit the ones before it.

        The metrics are `deviation`, see `change_detection`, and `segment`, the number
        of the segment after the chunk.
        """
        segment, settings = now.segment, self.plan.settings
        assert segment is not None
        deviation = float("nan")
        chunk = chunk_steps(settings)
        if now.segment_time >= (change_detection.WINDOW + 1) * chunk:
            score = self.score(now, chunk)
            deviation = change_detection.deviation(segment.scores, score)
            if math.isfinite(score):
                scores = (*segment.scores, score)[-change_detection.HISTORY :]
                now = now._replace(segment=segment._replace(scores=scores))
        more = now.segment_number + 1 < self.plan.spec.segments
        if deviation > settings.detection_threshold and more:
            now = self.next_segment(now)
            self.recorder.progress.message(
                f"a change of task was noticed in task {now.stage + 1}, after "
                f"{now.steps * settings.envs:,} of its interactions"
            )
        metrics = {"deviation": deviation, "segment": now.segment_number}
        return now, {name: np.array([value]) for name, value in metrics.items()}

    def score(self, now: RunState, chunk: int) -> float:
        """Returns the newest chunk's score, see `change_detection.surprise`."""
        assert now.state is not None
        length = self.plan.scenario.environment.episode_length
        scores = _surprise(length, chunk)(now.state.collection.buffer, now.segment_time)
        return float(scores[0])

    def next_segment(self, now: RunState) -> RunState:
        """Ends the segment and starts another, in the running episodes."""
        program, index = self.plan.program, now.segment_number + 1
        assert now.state is not None
        learner = self.ended(now)
        assigned = segments.assign(learner.method_state, now.stage, index)
        assigned = population.place(assigned, self.plan.mesh)
        learner = learner._replace(method_state=assigned)
        state = program.start(
            self.plan.stacked,
            learner,
            now.active,
            index,
            now.state.collection.episodes,
        )
        return now._replace(state=state, segment=Segment(index, -now.steps, ()))

    def ended(self, now: RunState) -> TrainState:
        """The learner if its segment ended here; `now` stays usable.

        The steps of the report in which a change was noticed belong to the segment.
        """
        program, members = self.plan.program, self.plan.stacked
        rounds = self.plan.budget.offline_steps
        assert now.state is not None
        if now.segment_time == 0:
            return now.state.learner
        state = self.consolidated(now)
        if rounds:
            # The function uses its argument up.
            state = program.offline_update(
                members,
                jax.tree.map(jnp.copy, state),
                now.segment_number,
                now.segment_time,
                0,
                rounds,
            )
        return program.finish(members, state.learner, now.segment_number, None)

    def leave(self, now: RunState) -> RunState:
        """Takes a learner out as it would be if its segment ended here."""
        return now._replace(learner=self.ended(now))

    def conclude(self, now: RunState, task: Task) -> RunState:
        """Ends the task; the learner goes on in its segment."""
        assert now.segment is not None
        segment = now.segment._replace(offset=now.segment_time)
        return now._replace(stage=now.stage + 1, steps=0, segment=segment)


@functools.lru_cache
def _surprise(episode_length: int, chunk: int) -> Any:
    """`(buffer, time) -> [members]`, see `change_detection.surprise`."""
    score = functools.partial(
        change_detection.surprise, chunk=chunk, episode_length=episode_length
    )
    return jax.jit(jax.vmap(score, (0, None)))
