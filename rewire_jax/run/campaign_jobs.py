"""The runs of a campaign as processes, and what its folder knows of each.

probe/reach/ft1/seed-0/        folder of a run, as `rewire-jax train` writes it
jobs/probe/reach/ft1/seed-0/   about the run:
    log.txt                    what its command printed
    failed.json                how often it failed, and why
    .lock                      locked by the process that trains the run
"""

import os
import signal
import subprocess
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rewire_jax.core import compilation_cache
from rewire_jax.core.errors import UserError, writing
from rewire_jax.run import run_checkpoints
from rewire_jax.run.campaign_file import Campaign, PlannedRun
from rewire_jax.storage import run_folder
from rewire_jax.storage.json_lines import document, reading, text
from rewire_jax.storage.run_results import read_run

MOST_WORKERS = 1_024
_TRIES = 2  # after so many failures a run is set aside
Process = subprocess.Popen[bytes]


@dataclass(frozen=True)
class Job:
    """A run of a campaign in the campaign's folder.

    Attributes:
      root: folder of the campaign.
      run: what is trained.
    """

    root: Path
    run: PlannedRun

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.root / self.run.name

    @property
    def notes(self) -> Path:
        """Folder of what is known about the run."""
        return self.root / "jobs" / self.run.name

    @property
    def started(self) -> bool:
        """Whether the folder holds a run."""
        return (self.folder / run_folder.HEADER).exists()

    @property
    def done(self) -> bool:
        """Whether the run is finished; then its checkpoints may be deleted."""
        if self.started and (self.folder / "checkpoints").exists():
            return run_checkpoints.finished(self.folder, self.run.settings.tasks - 1)
        try:
            return self.started and read_run(self.folder).complete
        except UserError:
            return False

    @property
    def failures(self) -> int:
        """How often the run has failed since it was last told to be tried again."""
        return self._failed()[0]

    @property
    def reason(self) -> str | None:
        """Why the run is set aside; None if it is not."""
        times, reason = self._failed()
        return reason if times >= _TRIES else None

    def _failed(self) -> tuple[int, str]:
        path = self.notes / "failed.json"
        if not path.exists():
            return 0, ""
        with reading(path):
            known = document(path)
            return int(known["times"]), str(known["reason"])

    def note_failure(self, status: int) -> str:
        """Notes that the run's command failed, by its exit status; returns why."""
        reason = last_line(self.notes / "log.txt") or f"exit status {status}"
        if status < 0:
            reason = f"killed by {signal.Signals(-status).name}; last line: {reason}"
        times = self.failures + 1
        run_folder.write(
            self.notes / "failed.json", {"times": times, "reason": reason[:1000]}
        )
        return reason

    def forgive(self) -> None:
        """Forgets that the run failed."""
        with writing(self.notes):
            (self.notes / "failed.json").unlink(missing_ok=True)

    @contextmanager
    def claimed(self) -> Iterator[bool]:
        """Claims the run, as `run_folder.claimed` does; yields whether it is ours.

        It is not if another process of the campaign has it, or trains in its folder.
        """
        with run_folder.claimed(self.notes) as ours:
            free = False
            if ours:
                with run_folder.claimed(self.folder) as free:
                    pass
            yield free

    @property
    def running(self) -> bool:
        """Whether a process of the campaign trains the run now."""
        if not self.notes.exists():
            return False
        with run_folder.claimed(self.notes) as free:
            return not free

    def start(self, cores: Collection[int] = ()) -> Process:
        """Starts or continues the run in a process of its own, on these cores.

        It saves the run and ends when this process ends.

        Raises:
          UserError: the log cannot be written.
        """
        resume = ["--resume"] if self.started else []
        words = [*self.run.words(), "--out", str(self.folder), *resume]
        return start(words, self.notes / "log.txt", cores)


def folder_of(campaign: Campaign, out: str | Path | None) -> Path:
    """The folder of a campaign; by default `runs/` and the name of its file."""
    return Path(out or Path("runs") / campaign.path.stem)


def jobs_of(root: Path, runs: Sequence[PlannedRun], retry: bool = False) -> list[Job]:
    """The jobs of runs in a campaign's folder.

    Args:
      root: the folder.
      runs: the runs.
      retry: forget that runs failed, also of those that are set aside.

    Raises:
      UserError: a folder holds a run with other settings.
    """
    jobs = [Job(root, run) for run in runs]
    for job in jobs:
        if job.started:
            run_folder.compare(job.folder, job.run.settings)
    if retry:
        for job in jobs:
            job.forgive()
    return jobs


def start(words: Sequence[str], log: Path, cores: Collection[int] = ()) -> Process:
    """Starts a `rewire-jax` command that ends, saved, when this process does.

    Args:
      words: its arguments.
      log: file to which its output is appended.
      cores: cores to run on, where the system can do that; all if empty.

    Raises:
      UserError: the log cannot be written.
    """
    run_folder.make(log.parent)
    run_folder.refuse_link(log)
    with writing(log), log.open("ab") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "rewire_jax.cli.attended", *words],
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=subprocess.STDOUT,
            env=os.environ | compilation_cache.environment(),
            start_new_session=True,  # Only this process reacts to Ctrl-C.
        )
    if cores and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(process.pid, cores)
    return process


def last_line(path: Path) -> str:
    """The last line of a file that is not empty."""
    lines = text(path).split("\n") if path.exists() else []
    return next((line.strip() for line in reversed(lines) if line.strip()), "")
