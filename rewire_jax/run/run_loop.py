"""Trains a run task after task: evaluation, logging, checkpoints."""

import functools
import threading
import time as clock
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.envs.base import Task
from rewire_jax.methods.base import Selection
from rewire_jax.run import run_checkpoints, run_state
from rewire_jax.run.interrupts import Stopped
from rewire_jax.run.loggers import Loggers
from rewire_jax.run.progress import Progress
from rewire_jax.run.recorder import Recorder
from rewire_jax.run.run_state import RunState
from rewire_jax.training import (
    population,
    random_keys,
    rollout,
    run_setup,
    selection,
)
from rewire_jax.training.loop_state import RunnerState
from rewire_jax.training.random_keys import Stream
from rewire_jax.training.run_setup import Plan
from rewire_jax.training.sac import TrainState


class Run:
    """A run in its folder; stores paths and compiled functions, no learning state."""

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        progress: Progress,
        logs: Loggers | None = None,
        choosing: bool = False,
    ):
        """See `train_run.train`.

        Args:
          plan: plan of the run.
          folder: folder for tables and checkpoints; it must exist.
          progress: the display.
          logs: loggers of scalars; `start` opens them.
          choosing: whether each evaluation also plays other episodes, by which a sweep
            chooses between members.
        """
        self.plan = plan
        self.folder = folder
        self.logs = logs or Loggers((), (), progress.message)
        self.recorder = Recorder(plan, folder, progress, self.logs)
        self.choosing = choosing
        self.stopping = threading.Event()

    def start(self, now: RunState | None = None) -> RunState:
        """Starts the run: evaluates the untrained policies.

        Args:
          now: state of a run that is resumed; it is returned as it is.
        """
        if now is not None:
            self.logs.open(run_state.interactions(now, self.plan) + 1)
            return now
        self.logs.open(0)
        now = run_state.start(self.plan)
        self.evaluate(now, -1)
        return now

    def task(self, now: RunState, ahead: int) -> RunState:
        """Trains the rest of a task, evaluates and saves.

        Args:
          now: state of the run.
          ahead: see `Recorder.ahead`.

        Raises:
          Stopped: interrupted, and saved.
        """
        began = clock.perf_counter()
        self.recorder.ahead = ahead
        stage = now.stage
        task = jax.tree.map(lambda leaf: leaf[stage], self.plan.tasks)
        if now.steps == 0:
            now = self.begin(now, task)
        while now.steps < self.end:
            offline = now.steps >= self.plan.budget.steps
            now = self.offline_update(now) if offline else self.chunk(now, task)
            if self.stopping.is_set():
                run_checkpoints.save(self.folder, now, self.plan)
                raise Stopped(
                    f"stopped and saved: continue with --resume --out {self.folder}"
                )
        # One after the other, so that nothing holds the replay buffer any longer.
        now = self.leave(now)
        now = self.conclude(now, task)
        returns = self.evaluate(now, stage)[:, stage]
        run_checkpoints.save(self.folder, now, self.plan)
        self.recorder.finished(stage, returns, clock.perf_counter() - began)
        return now

    @property
    def end(self) -> int:
        """`RunState.steps` at the end of a task."""
        return self.plan.budget.steps + self.plan.budget.offline_steps

    def begin(self, now: RunState, task: Task) -> RunState:
        """Starts a task: fresh optimisers, environments and buffer."""
        program, members, stage = self.plan.program, self.plan.stacked, now.stage
        state = program.begin(members, now.learner, now.active, stage, task)
        now = now._replace(learner=None, state=state)
        if not program.baseline:
            return now
        before, selection = self.select(now, state.learner, task, 0)
        if program.after_baseline and before is not None:
            state = program.after_baseline(members, state, before)
        return now._replace(state=state, before=before, selection=selection)

    def select(
        self, now: RunState, learner: TrainState, task: Task, phase: int
    ) -> tuple[jax.Array | None, jax.Array]:
        """Evaluates the candidates at the start (phase 0) or end (1) of a task.

        Returns:
          Mean returns `[members, candidates]` (None if the method chooses nothing), and
          the interactions spent on candidates so far, `[members]`.
        """
        program, rows = self.plan.program, self.plan.budget.rows
        if program.candidates is None or not rows:
            return None, now.selection
        candidates = program.candidates(self.plan.stacked, learner, now.stage)
        mesh = self.plan.mesh
        if not candidates.valid.any():
            # `end_task` gets the same types as after an evaluation: it is traced once.
            return population.place(
                (jnp.zeros(candidates.valid.shape), now.selection), mesh
            )
        result = program.trial(
            jax.tree.map(lambda leaf: np.stack([leaf] * rows), task),
            # Without `place`, the function would be traced once more.
            population.place(_fill(candidates.policies, rows), mesh),
            self.keys(Stream.SELECTION, 2 * now.stage + phase, rows),
            self.plan.settings.selection_episodes,
        )
        return population.place(_judge(result, candidates.valid, now.selection), mesh)

    def keys(self, stream: int, number: int, rows: int) -> jax.Array:
        """Returns keys `[members, rows]` that depend only on seeds and arguments."""
        return _make_keys(self.plan.stacked.keys, stream, number, rows)

    def chunk(self, now: RunState, task: Task) -> RunState:
        """Trains until the next progress report."""
        began = clock.perf_counter()
        program, members, done = self.plan.program, self.plan.stacked, now.steps
        every = run_setup.chunk_steps(self.plan.settings)
        steps = _due(every, done, self.plan.budget.steps)
        traces = program.traces()
        state, report = program.chunk(
            members, now.state, now.segment_number, task, now.segment_time, steps
        )
        report = jax.tree.map(np.asarray, report)
        compiles = program.traces() > traces
        now = self.advance(now, state, steps)
        now, noticed = self.after_chunk(now)
        seconds = clock.perf_counter() - began
        report = report._replace(inspected=report.inspected | noticed)
        self.recorder.chunk(now, report, seconds, compiles, steps)
        self.save(now, done)
        return now

    def after_chunk(self, now: RunState) -> tuple[RunState, dict[str, np.ndarray]]:
        """Lets the method consolidate after the last interaction of a task.

        Args:
          now: state of the run after the chunk.

        Returns:
          The state, and metrics `[members]` to report.
        """
        if now.steps == self.plan.budget.steps:
            now = now._replace(state=self.consolidated(now))
        return now, {}

    def consolidated(self, now: RunState) -> RunnerState:
        """Returns the state after the method has consolidated, if it does."""
        program, state = self.plan.program, now.state
        assert state is not None
        if not program.consolidate:
            return state
        members, place = self.plan.stacked, (now.segment_number, now.segment_time)
        return state._replace(learner=program.consolidate(members, state, *place))

    def offline_update(self, now: RunState) -> RunState:
        """Updates from the buffer until the next progress report."""
        began = clock.perf_counter()
        plan, budget = self.plan, self.plan.budget
        before, settings = now.steps, plan.settings
        rounds = run_setup.chunk_steps(settings) // settings.update_every
        steps = _due(rounds, before, self.end)
        traces = plan.program.traces()
        state = plan.program.offline_update(
            plan.stacked,
            now.state,
            now.stage,
            budget.steps,
            before - budget.steps,
            steps,
        )
        now = self.advance(now, state, steps)
        compiles = plan.program.traces() > traces
        self.recorder.offline(now, clock.perf_counter() - began, compiles)
        self.save(now, before)
        return now

    def advance(self, now: RunState, state: RunnerState, steps: int) -> RunState:
        """Returns the state after these steps; reports members that became inactive."""
        active = np.array(state.active)
        self.recorder.frozen(now, active)
        return now._replace(steps=now.steps + steps, state=state, active=active)

    def save(self, now: RunState, before: int) -> None:
        """Writes a checkpoint in the middle of a task if one is due after `before`."""
        settings = self.plan.settings
        interval = max(settings.checkpoint_every // settings.envs, 1)
        due = settings.checkpoint_every and now.steps // interval > before // interval
        if due and now.steps < self.end:
            run_checkpoints.save(self.folder, now, self.plan)

    def leave(self, now: RunState) -> RunState:
        """Takes the learner out of a task; its replay buffer is freed."""
        assert now.state is not None
        return now._replace(learner=now.state.learner, state=None)

    def conclude(self, now: RunState, task: Task) -> RunState:
        """Evaluates the candidates, then lets the method end the task."""
        program, members, stage = self.plan.program, self.plan.stacked, now.stage
        learner = now.learner
        assert learner is not None
        after, spent = self.select(now, learner, task, 1)
        chosen_by = None if after is None else Selection(now.before, after)
        return RunState(
            stage=stage + 1,
            steps=0,
            learner=program.finish(members, learner, stage, chosen_by),
            state=None,
            before=None,
            active=now.active,
            selection=spent,
        )

    def evaluate(self, now: RunState, stage: int) -> np.ndarray:
        """Plays all tasks without exploration; returns `[members, tasks]`."""
        plan, settings = self.plan, self.plan.settings
        program, members = plan.program, plan.stacked
        policies = program.policies(members, now.learner)

        def play(stream):
            keys = self.keys(stream, stage + 1, settings.tasks)
            result = program.rollout(plan.tasks, policies, keys, settings.eval_episodes)
            means = {"return": result.returns} | rollout.named(result.success)
            return {
                name: np.asarray(values, np.float64).mean(axis=2)
                for name, values in means.items()
            }

        scores = play(Stream.EVALUATION)
        if self.choosing:
            scores["choice"] = play(Stream.CHOICE)["return"]
        self.recorder.evaluation(now, stage, scores)
        return scores["return"][: len(plan.members)]


def _due(every: int, done: int, end: int) -> int:
    """Returns the steps until the next multiple of `every`, or until the end."""
    return min(every - done % every, end - done)


@functools.partial(jax.jit, static_argnames="rows")
def _make_keys(keys: jax.Array, stream: int, number: int, rows: int) -> jax.Array:
    """Keys `[members, rows]` for a number in a stream, from `[members]`."""
    of_rollout = functools.partial(random_keys.of_rollout, rows=rows)
    return jax.vmap(of_rollout, (0, None, None))(keys, stream, number)


@functools.partial(jax.jit, static_argnames="rows")
def _fill(policies: Any, rows: int) -> Any:
    """Policies `[members, candidates]` in so many rows."""
    return jax.vmap(functools.partial(selection.fill, rows=rows))(policies)


_judge = jax.jit(jax.vmap(selection.judge))
