"""Trains the runs of a campaign in processes side by side, and stops in time."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import NamedTuple

from rewire_jax.core.arguments import check_seconds, check_whole
from rewire_jax.run.campaign_file import read_campaign
from rewire_jax.run.campaign_jobs import (
    MOST_WORKERS,
    Job,
    Process,
    folder_of,
    jobs_of,
)
from rewire_jax.run.campaign_population import decide
from rewire_jax.run.campaign_status import hours_left
from rewire_jax.run.interrupts import Stopped

_POLL = 0.2  # seconds between two looks at the processes
_WAIT = 2.0  # seconds, while other processes train all that is left
_SAVING = 60.0  # seconds before the end, at most, in which runs are saved
_GRACE = 5.0  # seconds after the end until processes are killed
_SIGNALS = signal.SIGINT, signal.SIGINT, signal.SIGKILL


class _Training(NamedTuple):
    """A job in training, its process, its cores, its start, and its claim."""

    job: Job
    process: Process
    cores: Collection[int]
    since: float
    claim: ExitStack


class Crew:
    """Trains jobs, as many at the same time as there are sets of cores.

    Attributes:
      jobs: all jobs, in their order.
      free: sets of cores without a process.
      training: what is in training.
      stops: how often the user asked to stop.
      told: signals that the processes got so far.
    """

    def __init__(
        self, jobs: Sequence[Job], slots: Sequence[Collection[int]], limit: float | None
    ):
        """Trains nothing yet.

        Args:
          jobs: all jobs, in their order.
          slots: a set of cores for each process.
          limit: seconds until the end; None for no limit.
        """
        self.jobs = jobs
        self.free = list(slots)
        self.workers = len(slots)
        self.training: list[_Training] = []
        self.stops = self.told = 0
        end = time.monotonic() + (float("inf") if limit is None else limit)
        early = 0.0 if limit is None else min(_SAVING, limit / 10)
        self.deadlines = end - early, end, end + _GRACE

    def work(self) -> None:
        """Trains until nothing is left, or until the end."""
        while True:
            self.reap()
            self.tell()
            pause = _POLL
            if self.told:
                if not self.training:
                    return
            elif self.free:
                left = self.left()
                if not left and not self.training:
                    return
                self.begin(left)
                pause = _POLL if self.training else _WAIT
            time.sleep(pause)

    def left(self) -> list[Job]:
        """Jobs neither finished nor set aside nor in training here, in order."""
        ours = [each.job for each in self.training]
        left = [j for j in self.jobs if j not in ours and not j.done and not j.reason]
        # What failed comes last.
        return sorted(left, key=lambda job: job.failures)

    def begin(self, left: Sequence[Job]) -> None:
        """Starts jobs while there are free cores."""
        for job in left:
            if not self.free:
                return
            with ExitStack() as stack:
                if stack.enter_context(job.claimed()) and not job.done:
                    cores = self.free.pop()
                    process = job.start(cores)
                    now = time.monotonic()
                    claim = stack.pop_all()
                    self.training.append(_Training(job, process, cores, now, claim))

    def reap(self) -> None:
        """Notes which processes have ended, and how."""
        for each in list(self.training):
            if (ended := each.process.poll()) is None:
                continue
            self.training.remove(each)
            self.free.append(each.cores)
            with each.claim:
                if ended == 0:
                    each.job.forgive()
                    took = timedelta(seconds=round(time.monotonic() - each.since))
                    said = f"finished in {took}"
                elif self.told:
                    said = "stopped; the next call continues it"
                else:
                    said = f"failed: {each.job.note_failure(ended)}"
            self.say(f"{each.job.run.name}: {said}")

    def tell(self) -> None:
        """Tells processes to save and end, if it is time or the user asked to."""
        late = sum(time.monotonic() >= deadline for deadline in self.deadlines)
        while self.told < min(max(late, self.stops), len(_SIGNALS)):
            for each in self.training:
                each.process.send_signal(_SIGNALS[self.told])
            self.told += 1

    def say(self, what: str) -> None:
        """Prints a line, with how much is done."""
        done = [job for job in self.jobs if job.done]
        rest = [job for job in self.jobs if not job.done and not job.reason]
        hours, left = hours_left(done, rest), ""
        if hours:
            seconds = round(hours * 3600 / self.workers)
            left = f", about {timedelta(seconds=seconds)} left"
        count = f"{len(done)} of {len(self.jobs)} finished{left}"
        print(f"{what} ({count})", file=sys.stderr, flush=True)


@contextmanager
def _heard(crew: Crew) -> Iterator[None]:
    """SIGINT and SIGTERM stop the crew, not this process."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: object) -> None:
        crew.stops += 1

    heard = signal.SIGINT, signal.SIGTERM
    before = [signal.signal(number, handle) for number in heard]
    try:
        yield
    finally:
        for number, previous in zip(heard, before, strict=True):
            signal.signal(number, previous)


def slots(workers: int) -> list[Collection[int]]:
    """The cores of each of so many processes; empty where a process uses all."""
    if not hasattr(os, "sched_getaffinity"):
        return [()] * workers
    cores = sorted(os.sched_getaffinity(0))
    if workers == 1 or workers > len(cores):
        return [()] * workers
    return [cores[i::workers] for i in range(workers)]


def default_workers() -> int:
    """As many processes as cores; one if there is an accelerator."""
    # Asked in another process: this one must not take the accelerator's memory.
    asked = subprocess.run(
        [sys.executable, "-c", "import jax; print(jax.default_backend())"],
        capture_output=True,
        text=True,
        check=False,
    )
    if asked.stdout.strip() != "cpu":
        return 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def campaign(
    file: str | Path,
    out: str | Path | None = None,
    *,
    limit: float | None = None,
    workers: int = 0,
    retry: bool = False,
) -> Path:
    """Trains what is missing of a campaign, in processes side by side.

    `campaign_file` describes the file, and `campaign_jobs` the folder. Several calls,
    also on several machines that share a file system, share the runs.

    Args:
      file: TOML file of the campaign.
      out: folder of the campaign; by default `runs/` and the name of the file.
      limit: seconds after which to stop; runs are saved, and the next call continues.
      workers: processes at the same time; 0 for as many as there are cores, or for one
        if there is an accelerator.
      retry: also train runs that were set aside because they failed.

    Returns:
      The folder.

    Raises:
      UserError: something in the file is wrong, or a folder holds another run.
      Stopped: interrupted, and saved.
    """
    check_whole("--workers", workers, 0, MOST_WORKERS)
    if limit is not None:
        check_seconds("--for", limit)
    made = read_campaign(file)
    root = folder_of(made, out)
    processes = workers or default_workers()
    runs = decide(made, root, slots(processes))
    if not workers and any(len(run.seeds) > 1 for run in runs):
        processes = 1  # A population uses all cores.
    crew = Crew(jobs_of(root, runs, retry), slots(processes), limit)
    with _heard(crew):
        crew.work()
    if crew.stops:
        raise Stopped(f"stopped and saved in {root}: repeat the command to continue")
    return root
