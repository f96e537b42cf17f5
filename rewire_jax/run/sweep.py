"""A sweep: configurations times seeds as one population, task after task.

settings.json        what all members share, the axes, the members, provenance
task-000/            the first task
  batches.json       which members are trained on it together
  batch-000/         their tables and checkpoints, as a run's (see `run_folder`)

All members are trained on a task, in batches that fit the memory, before the next one.
So the worst can be dropped between tasks (halving, Jamieson and Talwalkar 2016).
"""

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.arguments import check_whole, require
from rewire_jax.core.errors import UserError
from rewire_jax.core.formatting import short
from rewire_jax.core.settings import Settings
from rewire_jax.envs.scenarios import Scenario
from rewire_jax.run import (
    loggers,
    run_checkpoints,
    run_state,
    sweep_members,
    task_header,
)
from rewire_jax.run.interrupts import Stopped, interruptible
from rewire_jax.run.loggers import Loggers
from rewire_jax.run.progress import Progress
from rewire_jax.run.ranking import rank
from rewire_jax.run.run_loop import Run
from rewire_jax.run.run_state import RunState
from rewire_jax.run.sweep_grid import (
    draws,
    grid,
    make_members,
    read,
    read_axis,
)
from rewire_jax.storage import checkpoint, run_folder
from rewire_jax.storage.sweep_results import batch, batches_of, read_batches, read_sweep
from rewire_jax.training import memory_estimate, population
from rewire_jax.training.population import Member
from rewire_jax.training.run_setup import Plan, complete, prepare

_POLL = 1.0  # seconds, to wait for another process


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """A sweep, ready to run.

    Attributes:
      folder: folder of the sweep.
      settings: settings of the first configuration; others differ only in the axes.
      scenario: scenario of all members.
      members: all members; the seeds of a configuration are consecutive.
      axes: names of the settings in which members differ.
      halving: one in this many configurations continues with the next task.
      most: largest number of members trained at the same time.
      log: loggers that also get the scalars, see `train`.
      progress: class of the display.
    """

    folder: Path
    settings: Settings
    scenario: Scenario
    members: tuple[Member, ...]
    axes: tuple[str, ...]
    halving: int
    most: int
    log: tuple[str, ...]
    progress: Callable[..., Progress]

    def run(self) -> None:
        """Trains the batches that no other process trains, until all are finished.

        Raises:
          Stopped: interrupted; finished steps are saved.
        """
        try:
            for stage in range(self.settings.tasks):
                batches, num_slots = self.batches(stage)
                while left := self.unfinished(stage, len(batches)):
                    claims = [self.claim(stage, n, batches, num_slots) for n in left]
                    if not any(claims):
                        time.sleep(_POLL)
        except (Stopped, KeyboardInterrupt):
            raise Stopped(
                f"stopped and saved in {self.folder}: to continue, give the "
                "same command with --resume"
            ) from None

    def batches(self, stage: int) -> tuple[list[list[int]], int]:
        """Returns the members of each batch on a task, and the size of a batch."""
        path = batches_of(self.folder, stage)
        while not path.exists():
            with run_folder.claimed(path.parent) as ours:
                if ours and not path.exists():
                    numbers = self.survivors(stage)
                    size, count = self.share(len(numbers))
                    batches = [numbers[i * size : (i + 1) * size] for i in range(count)]
                    run_folder.write(path, {"size": size, "batches": batches})
            if not ours:
                time.sleep(_POLL)
        return read_batches(path)

    def survivors(self, stage: int) -> list[int]:
        """Returns the members to train on a task."""
        if stage == 0:
            return [member.number for member in self.members]
        before = [n for batch in self.batches(stage - 1)[0] for n in batch]
        if self.halving == 1:
            return before
        data = read_sweep(self.folder)
        scores = data.choice[before, stage - 1, :stage].mean(axis=1)
        scores = np.where(data.diverged[before, stage - 1], np.nan, scores)
        seeds = self.settings.seeds
        order = rank(scores.reshape(-1, seeds))
        kept = order[: math.ceil(len(order) / self.halving)]
        return [n for i in sorted(kept) for n in before[i * seeds : (i + 1) * seeds]]

    def share(self, members: int) -> tuple[int, int]:
        """Returns the size of a batch and the number of batches."""
        devices = jax.local_device_count()
        # A batch is divided equally between the devices.
        most = max(self.most - self.most % devices, min(self.most, devices))
        count = math.ceil(members / most)
        size = math.ceil(members / count)
        if size > devices:
            size = devices * math.ceil(size / devices)
        return size, math.ceil(members / size)

    def unfinished(self, stage: int, batches: int) -> list[int]:
        """Returns the batches of a task that are not finished."""
        folders = [batch(self.folder, stage, number) for number in range(batches)]
        return [
            n for n, f in enumerate(folders) if not run_checkpoints.finished(f, stage)
        ]

    def claim(
        self, stage: int, number: int, batches: list[list[int]], num_slots: int
    ) -> bool:
        """Trains a batch on a task unless another process does; returns whether."""
        folder = batch(self.folder, stage, number)
        with run_folder.claimed(folder) as ours:
            if ours and not run_checkpoints.finished(folder, stage):
                self.train(stage, number, batches, num_slots)
        return ours

    def plan(self, numbers: Sequence[int], num_slots: int) -> Plan:
        """Returns the plan of a batch."""
        members = [self.members[number] for number in numbers]
        return prepare(self.settings, self.scenario, members, num_slots)

    def train(
        self, stage: int, number: int, batches: list[list[int]], num_slots: int
    ) -> None:
        """Trains a batch on a task, or the rest of it after a stop."""
        folder = batch(self.folder, stage, number)
        plan = self.plan(batches[number], num_slots)
        label = f"{self.settings.method} sweep on {self.settings.scenario}"
        if len(batches) > 1:
            label += f", batch {number + 1} of {len(batches)}"
        names = [member.name for member in plan.members]
        with ExitStack() as stack:
            display = stack.enter_context(
                self.progress(plan.names, plan.interactions, names, label)
            )
            subjects = [self.subject(member) for member in plan.members]
            logs = stack.enter_context(Loggers(self.log, subjects, display.message))
            run = Run(plan, folder, display, logs, choosing=True)

            def start() -> RunState:
                now = run_checkpoints.restore(folder, plan, display.message)
                if now is None and stage:
                    now = self.gather(stage, plan)
                return run.start(now)

            with interruptible(run.stopping, folder, display.message):
                # No variable holds the state, so that its memory can be freed.
                run.task(start(), self.ahead(stage, number, len(batches)))
            if run.stopping.is_set():  # since the last chunk
                raise Stopped

    def subject(self, member: Member) -> loggers.Subject:
        """Returns the log of a member; it is the same for all tasks."""
        values = {name: read(member, name) for name in self.axes}
        facts = [f"{name}={short(value)}" for name, value in values.items()]
        facts = [f"member-{member.number:03d}", *facts, f"seed={member.seed}"]
        return loggers.subject(self.folder, self.settings, member, ",".join(facts))

    def ahead(self, stage: int, number: int, batches: int) -> int:
        """Returns how many batches remain after this one, if no other process helps."""
        left = batches - number - 1
        for later in range(1, self.settings.tasks - stage):
            left += math.ceil(batches / self.halving**later)
        return left

    def gather(self, stage: int, plan: Plan) -> RunState:
        """Returns a batch's members as saved after the previous task, in any batch."""
        found: dict[int, Any] = {}
        wanted = {member.number for member in plan.members}
        batches, num_slots = self.batches(stage - 1)
        for number, numbers in enumerate(batches):
            if wanted.isdisjoint(numbers):
                continue
            folder = batch(self.folder, stage - 1, number)
            try:
                made = self.plan(numbers, num_slots)
                items = run_checkpoints.read_kept(folder, stage - 1, made)
            except checkpoint.CheckpointError as error:
                raise UserError(
                    f"{error}; delete {folder} and resume to train this batch again"
                ) from error
            for place, name in enumerate(numbers):
                found[name] = jax.tree.map(lambda leaf, p=place: leaf[p], items)
        rows = [found[member.number] for member in plan.members]
        rows += rows[:1] * (plan.num_slots - len(rows))
        items = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)
        return run_state.between(stage, items, plan)


def sweep(
    settings: Settings,
    out: str | Path,
    *,
    axes: Mapping[str, Sequence[float]] | None = None,
    configurations: Sequence[Mapping[str, float]] = (),
    random: int = 0,
    halving: int = 1,
    members_per_batch: int = 0,
    scenario: Scenario | None = None,
    resume: bool = False,
    join: bool = False,
    log: Sequence[str] = (),
    progress: Callable[..., Progress] = Progress,
) -> Path:
    """Trains every configuration with every seed as one population.

    Several processes can share a sweep in one folder. One starts it; the others call
    this function with the same arguments and `join`. Each trains a batch that no other
    process trains. If a process ends early, the others finish its batch.

    Args:
      settings: settings that all members share; each configuration has `seeds` seeds.
      out: folder of the sweep, new or empty; with `resume`, an unfinished sweep.
      axes: names of traced settings and their values; every combination is a
        configuration. `modes` is K.
      configurations: used instead of `axes`; values of the same settings in each.
      random: number of random configurations, used instead of all combinations. An
        axis is then a range, or one fixed value.
      halving: after each task, the best 1 / `halving` of the configurations continue,
        chosen by other episodes than the reported ones; 1 for all.
      members_per_batch: largest number of members trained at the same time; 0 for as
        many as fit.
      scenario: your own scenario; if None, the settings name it.
      resume: continue an unfinished sweep.
      join: help the process that started or resumed the sweep in this folder.
      log: loggers that also get the scalars, see `train`.
      progress: class of the display.

    Returns:
      The folder; see this module for what it holds, and `write_report`.

    Raises:
      UserError: invalid settings, a folder of another run, or a full disk.
      Stopped: interrupted, and saved.
    """
    folder = Path(out)
    check_whole("--halving", halving, 1)
    check_whole("--members-per-batch", members_per_batch)
    check_whole("--random", random)
    _, scenario = complete(settings, scenario)
    require(
        settings.boundaries == "given",
        "--boundaries detected: members would notice changes at different times; train "
        "them one by one, with rewire-jax train",
    )
    loggers.check(log)
    given = {name: read_axis(name, values) for name, values in (axes or {}).items()}
    require(bool(given or configurations), "a sweep needs an axis: --alpha 0 1e-5")
    every = len(configurations) or random or math.prod(map(len, given.values()))
    plan = prepare(settings, scenario, population.of_run(settings)[:1])
    memory_estimate.check_sweep(plan, every * settings.seeds, folder)
    if not configurations:
        configurations = draws(given, random, settings) if random else grid(given)
    settings, members = make_members(settings, configurations)
    plan = prepare(settings, scenario, members[:1])
    header = sweep_members.make_header(
        plan,
        members,
        tuple(configurations[0]),
        given,
        random=int(random),
        halving=int(halving),
    )
    with ExitStack() as stack:
        if not join:
            start = None if resume else header
            stack.enter_context(run_folder.held(folder, start, "sweep"))
        run_folder.compare(folder, plan.settings, "sweep")
        saved = run_folder.read_header(folder, "sweep")
        task_header.check_tasks(folder, saved, plan.scenario, len(plan.names))
        require(
            all(saved[name] == header[name] for name in ("members", "halving")),
            f"{folder} was started with other axes, seeds or halving: repeat them or "
            "use another --out",
        )
        need = memory_estimate.need(plan)
        made = Sweep(
            folder=folder,
            settings=plan.settings,
            scenario=scenario,
            members=members,
            axes=tuple(configurations[0]),
            halving=halving,
            most=members_per_batch
            or memory_estimate.fitting(need, jax.local_devices()),
            log=tuple(log),
            progress=progress,
        )
        size, _ = made.share(len(members))
        print(f"{need}; {len(members)} members, {size} at a time", file=sys.stderr)
        made.run()
    return folder
