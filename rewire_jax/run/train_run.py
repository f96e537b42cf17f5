"""A continual run: task after task, evaluation, logging, checkpoints."""

import functools
import signal
import threading
import time as clock
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.settings import Settings, to_json
from rewire_jax.envs.base import Task
from rewire_jax.envs.scenarios import Scenario
from rewire_jax.methods.base import Selection, map_own
from rewire_jax.run import interrupts, loggers, run_state
from rewire_jax.run.loggers import Loggers
from rewire_jax.run.progress import Progress
from rewire_jax.run.run_state import RunState
from rewire_jax.storage import run_folder
from rewire_jax.training import memory_estimate, population, rollout, train_loop
from rewire_jax.training.run_setup import Plan, base_size, prepare
from rewire_jax.training.sac import TrainState

# Streams of randomness beside training's, which is 1.
_EVALUATION, _SELECTION, _CHOICE = 2, 3, 4


class Stopped(Exception):
    """The run was interrupted and can be resumed; the message says how."""


class Run:
    """A run in its folder. Holds paths and compiled functions, no learning state."""

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
          plan: of the run.
          folder: for its tables and checkpoints; it must exist.
          progress: the display.
          logs: its scalars, too; opened by `start`.
          choosing: also plays episodes by which members can be chosen, apart from
            those that are reported.
        """
        self.plan = plan
        self.folder = folder
        self.progress = progress
        self.logs = logs or Loggers((), (), progress.message)
        self.choosing = choosing
        self.ahead = 0
        self.stopping = False

    def start(self, now: RunState | None = None) -> RunState:
        """The beginning of the run, after the evaluation of untrained policies.

        Args:
          now: where it stands already, if it does.
        """
        if now is not None:
            self.logs.open(run_state.interactions(now, self.plan) + 1)
            return now
        self.logs.open(0)
        now = run_state.start(self.plan)
        self.evaluate(now, -1)
        return now

    def task(self, now: RunState, ahead: int) -> RunState:
        """Trains what is left of a task, and concludes it.

        Args:
          now: where the run stands.
          ahead: populations that are still to be trained on a task after this.

        Raises:
          Stopped: interrupted, and saved.
        """
        began = clock.perf_counter()
        self.ahead = ahead
        plan, stage = self.plan, now.stage
        task = jax.tree.map(lambda leaf: leaf[stage], plan.tasks)
        if now.state is None:
            now = self.begin(now, task)
        while now.steps < plan.steps + plan.offline_steps:
            offline = now.steps >= plan.steps
            now = self.offline_update(now) if offline else self.chunk(now, task)
            if self.stopping:
                run_state.save(self.folder, now)
                raise Stopped(
                    f"stopped and saved: continue with --resume --out {self.folder}"
                )
        assert now.state is not None
        # The replay buffer goes before policies are rolled out.
        now = now._replace(learner=now.state.learner, state=None)
        now = self.conclude(now, task)
        returns = [_finite(float(r)) for r in self.evaluate(now, stage)[:, stage]]
        run_state.save(self.folder, now)
        self.progress.finish_task(stage, returns, clock.perf_counter() - began)
        return now

    def begin(self, now: RunState, task: Task) -> RunState:
        """Starts a task: fresh optimisers, environments and buffer."""
        program, members, stage = self.plan.program, self.plan.stacked, now.stage
        state = program.begin(members, now.learner, now.active, stage, task)
        now = now._replace(learner=None, state=state)
        if not program.baseline:
            return now
        before, selection = self.select(now, state.learner, task, 0)
        return now._replace(before=before, selection=selection)

    def select(
        self, now: RunState, learner: TrainState, task: Task, phase: int
    ) -> tuple[jax.Array | None, jax.Array]:
        """Rolls out the candidates at the start (phase 0) or end (1) of a task.

        Returns:
          Their mean returns `[members, candidates]`, None where nothing is to be
          chosen, and the interactions spent on candidates so far, `[members]`.
        """
        program, rows = self.plan.program, self.plan.rows
        if program.candidates is None or not rows:
            return None, now.selection
        candidates = program.candidates(self.plan.stacked, learner, now.stage)
        mesh = self.plan.mesh
        if not candidates.valid.any():
            # What is given to the end of a task is of one type, played or not.
            return population.place(
                (jnp.zeros(candidates.valid.shape), now.selection), mesh
            )
        result = program.trial(
            jax.tree.map(lambda leaf: np.stack([leaf] * rows), task),
            # Placed as all policies are: else the function is traced once more.
            population.place(_fill(candidates.policies, rows), mesh),
            self.keys(_SELECTION, 2 * now.stage + phase, rows),
            self.plan.settings.selection_episodes,
        )
        return population.place(_judge(result, candidates.valid, now.selection), mesh)

    def keys(self, stream: int, number: int, rows: int) -> jax.Array:
        """Random keys `[members, rows]` that depend on nothing but the arguments."""
        return _make_keys(self.plan.stacked.keys, stream, number, rows)

    def chunk(self, now: RunState, task: Task) -> RunState:
        """Trains until the next progress report."""
        began = clock.perf_counter()
        program, members, stage = self.plan.program, self.plan.stacked, now.stage
        done, unit = now.steps, self.plan.settings.update_every
        steps = self.due(done, self.plan.steps, unit)
        traces = program.traces()
        state, report = program.chunk(members, now.state, stage, task, done, steps)
        report = jax.tree.map(np.asarray, report)
        seconds = clock.perf_counter() - began
        compiles = program.traces() > traces
        now = self.advance(now, state, steps)
        self.log(now, report, seconds, compiles, steps)
        if now.steps == self.plan.steps and program.consolidate:
            learner = program.consolidate(members, state, stage, now.steps)
            now = now._replace(state=state._replace(learner=learner))
        self.save(now, done)
        return now

    def offline_update(self, now: RunState) -> RunState:
        """Updates from the buffer until the next progress report."""
        began = clock.perf_counter()
        plan, stage = self.plan, now.stage
        before = now.steps
        steps = self.due(before, plan.steps + plan.offline_steps, 1)
        traces = plan.program.traces()
        state = plan.program.offline_update(
            plan.stacked, now.state, stage, plan.steps, before - plan.steps, steps
        )
        now = self.advance(now, state, steps)
        timing = {
            "stage": stage,
            "interactions": plan.interactions,
            "polishing": now.steps - plan.steps,
            "seconds": clock.perf_counter() - began,
            "compile": plan.program.traces() > traces,
            "memory": memory_estimate.most_held(),
        }
        run_folder.append(self.folder, "timing.jsonl", [timing])
        share = (now.steps - plan.steps) / plan.offline_steps
        self.progress.update(
            stage,
            plan.interactions,
            [None] * len(plan.members),
            rate=None,
            note=f"updates without interactions: {share:.0%}",
        )
        self.save(now, before)
        return now

    def due(self, done: int, end: int, unit: int) -> int:
        """Steps until the next progress report, or until the end.

        `unit` is that of steps between two times of updates.
        """
        settings = self.plan.settings
        times = settings.report_every // (settings.envs * settings.update_every)
        every = max(times, 1) * unit
        return min(every - done % every, end - done)

    def advance(
        self, now: RunState, state: train_loop.RunnerState, steps: int
    ) -> RunState:
        """The run after these steps; tells of members that were frozen in them."""
        active = np.array(state.active)
        lost = now.active & ~active
        for place, member in enumerate(self.plan.members):
            if lost[place]:
                self.progress.message(
                    f"{member.name}: a value is not finite in task {now.stage}; it is "
                    "updated no more, try lower learning rates"
                )
        return now._replace(steps=now.steps + steps, state=state, active=active)

    def save(self, now: RunState, before: int) -> None:
        """Writes a checkpoint from within a task if one is due after `before`."""
        settings = self.plan.settings
        interval = max(settings.checkpoint_every // settings.envs, 1)
        due = settings.checkpoint_every and now.steps // interval > before // interval
        if due and now.steps < self.plan.steps + self.plan.offline_steps:
            run_state.save(self.folder, now)

    def log(
        self,
        now: RunState,
        report: train_loop.ChunkMetrics,
        seconds: float,
        compiled: bool,
        steps: int,
    ) -> None:
        """Writes a progress report to tables, events and screen."""
        plan, settings, stage = self.plan, self.plan.settings, now.stage
        interactions = now.steps * settings.envs
        returns: list[float | None] = []
        rows, known = [], []
        for place, member in enumerate(plan.members):
            ended = int(report.episodes[place])
            score = float(report.returns[place]) / ended if ended else None
            reward = float(report.rewards[place]) / steps
            # Few steps end an episode: show what this reward makes in a whole one.
            returns.append(_finite(reward * plan.scenario.environment.episode_length))
            updates = max(float(report.updates[place]), 1.0)
            metrics = {
                name: _finite(float(total[place]) / updates)
                for name, total in report.metrics.items()
            }
            where = {
                "stage": stage,
                "member": member.number,
                "seed": member.seed,
                "interactions": interactions,
            }
            scores = {"return": _finite(score), "reward": _finite(reward)}
            for name, solved in rollout.named(report.successes).items():
                scores[name] = float(solved[place]) / ended if ended else None
            for name, values in report.inspected.items():
                metrics[name] = _finite(float(values[place]))
            known.append(scores | metrics)
            rows.append(where | scores | metrics)
        run_folder.append(self.folder, "training.jsonl", rows)
        timing = {
            "stage": stage,
            "interactions": interactions,
            "seconds": seconds,
            "compile": compiled,
            "memory": memory_estimate.most_held(),
        }
        run_folder.append(self.folder, "timing.jsonl", [timing])
        for place, numbers in enumerate(known):
            self.logs.scalars(
                place, "training", numbers, run_state.interactions(now, plan)
            )
        rate = steps * settings.envs * len(rows) / seconds
        # As if steps that only update took as long as the others.
        steps_left = (plan.steps + plan.offline_steps) * (self.ahead + 1)
        left = (steps_left - now.steps) * settings.envs
        self.progress.update(
            stage,
            interactions,
            returns,
            rate,
            None if compiled else left * len(rows) / rate,
        )

    def conclude(self, now: RunState, task: Task) -> RunState:
        """Lets the method choose among its candidates, and end the task."""
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

        scores = play(_EVALUATION)
        if self.choosing:
            scores["choice"] = play(_CHOICE)["return"]
        sizes = np.asarray(program.size(members, now.learner))
        selection = np.asarray(now.selection)
        rows = [
            {
                "stage": stage,
                "task": index,
                "name": plan.names[index],
                "member": member.number,
                "seed": member.seed,
                "episodes": settings.eval_episodes,
                "interactions": {
                    "training": (stage + 1) * plan.interactions,
                    "selection": int(selection[place]),
                },
                "diverged": not bool(now.active[place]),
                "model_size": int(sizes[place]) / base_size(plan.spec),
            }
            | {name: _finite(float(x[place, index])) for name, x in scores.items()}
            for place, member in enumerate(plan.members)
            for index in range(settings.tasks)
        ]
        run_folder.append(self.folder, "results.jsonl", rows)
        for place in range(len(plan.members)):
            known = {
                f"{name}/{index:02d}-{task}": _finite(float(x[place, index]))
                for name, x in scores.items()
                for index, task in enumerate(plan.names)
            }
            self.logs.scalars(
                place, "evaluation", known, (stage + 1) * plan.interactions
            )
        return scores["return"][: len(plan.members)]


@functools.partial(jax.jit, static_argnames="rows")
def _make_keys(keys: jax.Array, stream: int, number: int, rows: int) -> jax.Array:
    """Keys `[members, rows]` for a number in a stream, from `[members]`."""

    def split(key):
        key = jax.random.fold_in(jax.random.fold_in(key, stream), number)
        # Unlike those of a split, the first do not depend on how many there are.
        return jax.vmap(lambda row: jax.random.fold_in(key, row))(jnp.arange(rows))

    return jax.vmap(split)(keys)


@functools.partial(jax.jit, static_argnames="rows")
def _fill(policies: Any, rows: int) -> Any:
    """Policies `[members, candidates]` in so many rows, over and over."""
    return map_own(lambda leaf: leaf[:, np.arange(rows) % leaf.shape[1]], policies)


@jax.jit
def _judge(
    result: rollout.Rollout, valid: jax.Array, selection: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """What `Run.select` returns, from what the candidates did in the first rows."""
    number = valid.shape[1]
    used = result.lengths[:, :number].sum(axis=2) * valid
    return result.returns[:, :number].mean(axis=2), selection + used.sum(axis=1)


def _finite(value: float | None) -> float | None:
    # JSON has no NaN.
    return value if value is not None and np.isfinite(value) else None


@contextmanager
def interruptible(run: Run) -> Iterator[None]:
    """Ctrl-C once: stop after the running chunk and save. Twice: stop at once.

    Raises:
      Stopped: at once.
    """

    def handle(number: int, frame: Any) -> None:
        if run.stopping:
            raise KeyboardInterrupt
        run.stopping = True

    def tell(times: int) -> None:
        if times == 1:
            run.progress.message("stopping after this chunk; Ctrl-C again: at once")

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGINT, handle)
    try:
        with interrupts.noticed(tell):
            yield
    except KeyboardInterrupt:
        raise Stopped(
            "stopped at once: continue from the newest checkpoint with --resume --out "
            f"{run.folder}"
        ) from None
    finally:
        signal.signal(signal.SIGINT, previous)


def train(
    settings: Settings,
    out: str | Path,
    *,
    scenario: Scenario | None = None,
    resume: bool = False,
    log: Sequence[str] = (),
    progress: Callable[..., Progress] = Progress,
) -> Path:
    """Learns a sequence of tasks; see `run_folder` for what it writes.

    Args:
      settings: of the run, for instance from `preset`.
      out: folder of the run, new or empty, or with `resume` an unfinished run's.
      scenario: one of your own; otherwise made from the settings.
      resume: continue from the newest checkpoint that is whole.
      log: where scalars go, too, a log for each member: "tensorboard", "wandb".
      progress: makes the display.

    Returns:
      The folder.

    Raises:
      UserError: wrong settings, a folder that does not fit, a full disk.
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
        stack.enter_context(interruptible(run))
        now = run_state.restore(folder, plan, display.message) if resume else None
        now = run.start(now)
        while now.stage < plan.settings.tasks:
            now = run.task(now, plan.settings.tasks - now.stage - 1)
    return folder
