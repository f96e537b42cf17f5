"""Records a run's progress: rows of its tables, logs, and the display."""

from pathlib import Path

import numpy as np

from rewire_jax.run import run_state
from rewire_jax.run.loggers import Loggers
from rewire_jax.run.progress import Progress
from rewire_jax.run.run_state import RunState
from rewire_jax.storage import run_folder
from rewire_jax.training import memory_estimate, rollout
from rewire_jax.training.loop_state import ChunkMetrics
from rewire_jax.training.run_setup import Plan, base_size


class Recorder:
    """Writes a run's tables and logs, and updates its display.

    Attributes:
      ahead: how many more times a task will be trained after the current one. The
        estimate of the remaining time depends on it. In a sweep each batch of members
        counts.
    """

    def __init__(self, plan: Plan, folder: Path, progress: Progress, logs: Loggers):
        self.plan = plan
        self.folder = folder
        self.progress = progress
        self.logs = logs
        self.ahead = 0

    def chunk(
        self,
        now: RunState,
        report: ChunkMetrics,
        seconds: float,
        compiled: bool,
        steps: int,
    ) -> None:
        """Records a chunk of training, the steps between two progress reports.

        Args:
          now: state of the run after the chunk.
          report: metrics of the chunk, as NumPy arrays `[members]`.
          seconds: duration of the chunk.
          compiled: whether the duration includes compiling.
          steps: vector steps in the chunk.
        """
        plan, settings, stage = self.plan, self.plan.settings, now.stage
        interactions = now.steps * settings.envs
        rows = self._training_rows(now, report, steps)
        run_folder.append(self.folder, "training.jsonl", rows)
        self._timing(now, interactions, seconds, compiled)
        known = ("stage", "member", "seed", "interactions")
        for place, row in enumerate(rows):
            numbers = {name: x for name, x in row.items() if name not in known}
            total = run_state.interactions(now, plan)
            self.logs.scalars(place, "training", numbers, total)
        rate = steps * settings.envs * len(rows) / seconds
        # The estimate assumes that offline updates take as long as vector steps.
        whole = plan.budget.steps + plan.budget.offline_steps
        left = (whole * (self.ahead + 1) - now.steps) * settings.envs
        length = plan.scenario.environment.episode_length
        self.progress.update(
            stage,
            interactions,
            # Few episodes end in a chunk, so show the mean reward times their length.
            [_finite(float(x) / steps * length) for x in report.rewards[: len(rows)]],
            rate,
            None if compiled else left * len(rows) / rate,
        )

    def _training_rows(
        self, now: RunState, report: ChunkMetrics, steps: int
    ) -> list[dict[str, float | None]]:
        """Returns a row for each member: means over a chunk of `steps` vector steps."""
        rows = []
        for place, member in enumerate(self.plan.members):
            ended = int(report.episodes[place])
            updates = max(float(report.updates[place]), 1.0)
            row: dict[str, float | None] = {
                "stage": now.stage,
                "member": member.number,
                "seed": member.seed,
                "interactions": now.steps * self.plan.settings.envs,
                "return": _finite(float(report.returns[place]) / ended)
                if ended
                else None,
                "reward": _finite(float(report.rewards[place]) / steps),
            }
            for name, solved in rollout.named(report.successes).items():
                row[name] = float(solved[place]) / ended if ended else None
            for name, total in report.metrics.items():
                row[name] = _finite(float(total[place]) / updates)
            for name, values in report.inspected.items():
                row[name] = _finite(float(values[place]))
            rows.append(row)
        return rows

    def offline(self, now: RunState, seconds: float, compiled: bool) -> None:
        """Records offline updates; the arguments are those of `chunk`."""
        plan = self.plan
        done = now.steps - plan.budget.steps
        self._timing(now, plan.interactions, seconds, compiled, polishing=done)
        share = done / plan.budget.offline_steps
        self.progress.update(
            now.stage,
            plan.interactions,
            [None] * len(plan.members),
            rate=None,
            note=f"updates without interactions: {share:.0%}",
        )

    def _timing(
        self,
        now: RunState,
        interactions: int,
        seconds: float,
        compiled: bool,
        **more: int,
    ) -> None:
        row = {
            "stage": now.stage,
            "interactions": interactions,
            **more,
            "seconds": seconds,
            "compile": compiled,
            "memory": memory_estimate.most_held(),
        }
        run_folder.append(self.folder, "timing.jsonl", [row])

    def frozen(self, now: RunState, active: np.ndarray) -> None:
        """Prints a line for each member that has just become inactive.

        Args:
          now: state of the run before the chunk.
          active: `[members]` bool, after the chunk.
        """
        for place, member in enumerate(self.plan.members):
            if now.active[place] and not active[place]:
                self.progress.message(
                    f"{member.name}: a parameter became NaN or infinite in task "
                    f"{now.stage + 1}; it is no longer updated: try lower learning "
                    "rates"
                )

    def evaluation(
        self, now: RunState, stage: int, scores: dict[str, np.ndarray]
    ) -> None:
        """Records an evaluation of all tasks.

        Args:
          now: state of the run.
          stage: the latest finished task; -1 before the first task.
          scores: mean returns and success rates `[members, tasks]`, by name.
        """
        plan, settings = self.plan, self.plan.settings
        numbers = plan.program.size(plan.stacked, now.learner)
        sizes, stored = (np.asarray(x) / base_size(plan.spec) for x in numbers)
        selection = np.asarray(now.selection)
        interactions = (stage + 1) * plan.interactions
        rows = [
            {
                "stage": stage,
                "task": index,
                "name": plan.names[index],
                "member": member.number,
                "seed": member.seed,
                "episodes": settings.eval_episodes,
                "interactions": {
                    "training": interactions,
                    "selection": int(selection[place]),
                },
                # A return can overflow although the parameters have not.
                "diverged": not now.active[place]
                or not all(np.isfinite(x[place, index]) for x in scores.values()),
                "model_size": float(sizes[place]),
            }
            | ({"stored_states": float(stored[place])} if stored[place] else {})
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
            self.logs.scalars(place, "evaluation", known, interactions)

    def finished(self, stage: int, returns: np.ndarray, seconds: float) -> None:
        """Shows that a task is finished.

        Args:
          stage: the task.
          returns: `[members]`, returns on this task, evaluated after its training.
          seconds: time since the start or the resumption of the task.
        """
        means = [_finite(float(mean)) for mean in returns]
        self.progress.finish_task(stage, means, seconds)


def _finite(value: float) -> float | None:
    # JSON has no NaN.
    return value if np.isfinite(value) else None
