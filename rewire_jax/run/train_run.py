"""Trains on a sequence of tasks, in a folder."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from rewire_jax.core.settings import Settings
from rewire_jax.core.settings_json import to_json
from rewire_jax.envs.scenarios import Scenario
from rewire_jax.run import loggers, run_checkpoints, task_header
from rewire_jax.run.detecting_run import DetectingRun
from rewire_jax.run.interrupts import interruptible
from rewire_jax.run.loggers import Loggers
from rewire_jax.run.progress import Progress
from rewire_jax.run.run_loop import Run
from rewire_jax.storage import run_folder
from rewire_jax.training import (
    memory_estimate,
)
from rewire_jax.training.run_setup import prepare


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
        **task_header.header_of_tasks(plan.scenario, len(plan.names)),
        "spec": plan.spec._asdict(),
        "provenance": run_folder.provenance(),
    }
    label = f"{settings.method} on {settings.scenario}"
    with ExitStack() as stack:
        stack.enter_context(run_folder.held(folder, None if resume else header))
        if resume:
            run_folder.compare(folder, plan.settings)
            task_header.check_tasks(
                folder, run_folder.read_header(folder), plan.scenario, len(plan.names)
            )
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
        kind = DetectingRun if settings.boundaries == "detected" else Run
        run = kind(plan, folder, display, logs)
        stack.enter_context(interruptible(run.stopping, folder, display.message))
        now = run_checkpoints.restore(folder, plan, display.message) if resume else None
        now = run.start(now)
        while now.stage < plan.settings.tasks:
            now = run.task(now, plan.settings.tasks - now.stage - 1)
    return folder
