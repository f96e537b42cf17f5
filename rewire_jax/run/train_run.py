"""A continual run: task after task, evaluation, logging, checkpoints."""

import functools
import threading
import time as clock
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.settings import Settings
from rewire_jax.core.settings_json import to_json
from rewire_jax.envs.base import Task
from rewire_jax.envs.scenarios import Scenario
from rewire_jax.methods.base import Selection
from rewire_jax.run import header_check, loggers, run_state
from rewire_jax.run.interrupts import Stopped, interruptible
from rewire_jax.run.loggers import Loggers
from rewire_jax.run.progress import Progress
from rewire_jax.run.recorder import Recorder
from rewire_jax.run.run_state import RunState
from rewire_jax.storage import run_folder
from rewire_jax.training import (
    memory_estimate,
    population,
    random_keys,
    rollout,
    selection,
)
from rewire_jax.training.loop_state import RunnerState
from rewire_jax.training.random_keys import Stream
from rewire_jax.training.run_setup import Plan, prepare
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
        """See `train`.

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
        plan, stage = self.plan, now.stage
        task = jax.tree.map(lambda leaf: leaf[stage], plan.tasks)
        if now.state is None:
            now = self.begin(now, task)
        budget = plan.budget
        while now.steps < budget.steps + budget.offline_steps:
            offline = now.steps >= budget.steps
            now = self.offline_update(now) if offline else self.chunk(now, task)
            if self.stopping.is_set():
                run_state.save(self.folder, now, self.plan)
                raise Stopped(
                    f"stopped and saved: continue with --resume --out {self.folder}"
                )
        assert now.state is not None
        # The replay buffer is freed before policies are evaluated.
        now = now._replace(learner=now.state.learner, state=None)
        now = self.conclude(now, task)
        returns = self.evaluate(now, stage)[:, stage]
        run_state.save(self.folder, now, self.plan)
        self.recorder.finished(stage, returns, clock.perf_counter() - began)
        return now

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
        program, members, stage = self.plan.program, self.plan.stacked, now.stage
        done, unit = now.steps, self.plan.settings.update_every
        steps = self.due(done, self.plan.budget.steps, unit)
        traces = program.traces()
        state, report = program.chunk(members, now.state, stage, task, done, steps)
        report = jax.tree.map(np.asarray, report)
        seconds = clock.perf_counter() - began
        compiles = program.traces() > traces
        now = self.advance(now, state, steps)
        self.recorder.chunk(now, report, seconds, compiles, steps)
        if now.steps == self.plan.budget.steps and program.consolidate:
            learner = program.consolidate(members, state, stage, now.steps)
            now = now._replace(state=state._replace(learner=learner))
        self.save(now, done)
        return now

    def offline_update(self, now: RunState) -> RunState:
        """Updates from the buffer until the next progress report."""
        began = clock.perf_counter()
        plan, budget = self.plan, self.plan.budget
        before = now.steps
        steps = self.due(before, budget.steps + budget.offline_steps, 1)
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

    def due(self, done: int, end: int, unit: int) -> int:
        """Returns the steps until the next progress report, or until the end.

        `unit` is the number of steps between two rounds of updates.
        """
        settings = self.plan.settings
        times = settings.report_every // (settings.envs * settings.update_every)
        every = max(times, 1) * unit
        return min(every - done % every, end - done)

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
        budget = self.plan.budget
        if due and now.steps < budget.steps + budget.offline_steps:
            run_state.save(self.folder, now, self.plan)

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


def train(
    settings: Settings,
    out: str | Path,
    *,
    scenario: Scenario | None = None,
    resume: bool = False,
    log: Sequence[str] = (),
    progress: Callable[..., Progress] = Progress,
) -> Path:
    """Trains on a sequence of tasks; `run_folder` describes the files it writes.

    Args:
      settings: settings of the run, for instance from `preset`.
      out: folder of the run, new or empty; with `resume`, folder of an unfinished run.
      scenario: your own scenario; if None, the settings name it.
      resume: continue from the newest complete checkpoint.
      log: loggers that also get the scalars, a log for each member: "tensorboard",
        "wandb".
      progress: class of the display.

    Returns:
      The folder.

    Raises:
      UserError: invalid settings, a folder of another run, or a full disk.
      Stopped: interrupted, and saved.
    """
    folder = Path(out)
    loggers.check(log)
    plan = prepare(settings, scenario)
    memory_estimate.check(plan)
    header = {
        "settings": to_json(plan.settings),
        "tasks": plan.names,
        "spec": plan.spec._asdict(),
        "episode_length": plan.scenario.environment.episode_length,
        "provenance": run_folder.provenance(),
    }
    label = f"{settings.method} on {settings.scenario}"
    with ExitStack() as stack:
        stack.enter_context(run_folder.held(folder, None if resume else header))
        if resume:
            run_folder.compare(folder, plan.settings)
            header_check.check_tasks(folder, run_folder.read_header(folder), plan)
        display = stack.enter_context(
            progress(
                plan.names, plan.interactions, [m.name for m in plan.members], label
            )
        )
        subjects = [
            loggers.subject(folder, plan.settings, member, f"seed-{member.seed}")
            for member in plan.members
        ]
        logs = stack.enter_context(Loggers(log, subjects, display.message))
        run = Run(plan, folder, display, logs)
        stack.enter_context(interruptible(run.stopping, folder, display.message))
        now = run_state.restore(folder, plan, display.message) if resume else None
        now = run.start(now)
        while now.stage < plan.settings.tasks:
            now = run.task(now, plan.settings.tasks - now.stage - 1)
    return folder
