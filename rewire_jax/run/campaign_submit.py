"""Submits the runs of a campaign to a cluster through submitit, a job for each run."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rewire_jax.core.arguments import check_seconds, check_whole
from rewire_jax.core.errors import UserError, writing
from rewire_jax.run.campaign_file import read_campaign
from rewire_jax.run.campaign_jobs import MOST_WORKERS, Job, folder_of, jobs_of
from rewire_jax.run.campaign_population import submitted_runs

if TYPE_CHECKING:
    import submitit

Cluster = Literal["slurm", "local"]
_MINUTES = 240  # of a job, if no time limit is given
_REQUEUES = 100  # times that a job may reach its time limit
_POLL = 1.0  # seconds between two looks at local jobs


class Work:
    """What a job of the cluster does: it trains one run, and tries again once.

    Before the time limit, submitit calls `checkpoint` and puts the job back in the
    queue.
    """

    def __init__(self, job: Job):
        self.job = job
        self.process: subprocess.Popen[bytes] | None = None
        self.ended: Future[int] | None = None

    def __call__(self) -> None:
        """Trains the run; does nothing if another process trains it."""
        with self.job.claimed() as ours, ThreadPoolExecutor(1) as thread:
            while ours and not self.job.done and self.job.reason is None:
                self.process = self.job.start()
                # `Popen.wait` here would hold a lock that `checkpoint` needs.
                self.ended = thread.submit(self.process.wait)
                if status := self.ended.result():
                    reason = self.job.note_failure(status)
                    print(f"{self.job.run.name}: failed: {reason}", file=sys.stderr)
                else:
                    self.job.forgive()

    def checkpoint(self) -> "submitit.helpers.DelayedSubmission":
        """Saves the run; returns what is put back in the queue."""
        from submitit.helpers import DelayedSubmission

        if self.process is not None and self.ended is not None:
            self.process.send_signal(signal.SIGINT)
            self.ended.result()
        return DelayedSubmission(Work(self.job))


def submit(
    file: str | Path,
    out: str | Path | None = None,
    *,
    cluster: Cluster,
    limit: float | None = None,
    workers: int = 0,
    retry: bool = False,
) -> list[str]:
    """Submits what is missing of a campaign, a job for each run.

    A run that is submitted twice is trained once. "local" runs the jobs on this machine
    and returns when they have ended.

    Args:
      file: TOML file of the campaign; its table `submit` has parameters of submitit's
        `AutoExecutor`, such as `slurm_partition`.
      out: folder of the campaign, as `campaign` has it.
      cluster: submitit's name of the cluster.
      limit: seconds after which a job saves its run and goes back to the queue.
      workers: jobs at the same time; 0 for no limit, or for one for each core if local.
      retry: also submit runs that were set aside because they failed.

    Returns:
      The identifiers of the jobs.

    Raises:
      UserError: something in the file is wrong, a folder holds another run, or submitit
        is missing or cannot submit.
    """
    try:
        import submitit
    except ImportError as error:
        raise UserError(
            'submitit is missing: pip install "rewire_jax[slurm]"'
        ) from error
    check_whole("--workers", workers, 0, MOST_WORKERS)
    if limit is not None:
        check_seconds("--for", limit)
    made = read_campaign(file)
    root = folder_of(made, out)
    jobs = jobs_of(root, submitted_runs(made, root), retry)
    left = [job for job in jobs if not job.done and job.reason is None]
    minutes = _MINUTES if limit is None else max(round(limit / 60), 1)
    parameters: dict[str, Any] = {"name": "rewire", "timeout_min": minutes}
    if cluster == "slurm" and workers:
        parameters["slurm_array_parallelism"] = workers
    try:
        with writing(root):
            executor = submitit.AutoExecutor(
                root / "submitted", cluster=cluster, slurm_max_num_timeout=_REQUEUES
            )
            executor.update_parameters(**parameters | dict(made.submit))
            if cluster == "local":
                return _locally(executor, left, workers or os.cpu_count() or 1)
            with executor.batch():
                submitted = [executor.submit(Work(job)) for job in left]
            return [each.job_id for each in submitted]
    except (AssertionError, NameError, RuntimeError, TypeError) as error:
        said = " ".join(str(error).split())
        raise UserError(f"{made.path}: submitit cannot submit: {said}") from error


def _locally(
    executor: "submitit.AutoExecutor", jobs: Sequence[Job], workers: int
) -> list[str]:
    """Runs so many jobs at the same time, until all have ended."""
    running: list[submitit.Job[None]] = []
    names = []
    for job in jobs:
        while len(running) >= workers:
            time.sleep(_POLL)
            running = [each for each in running if not each.done()]
        running.append(executor.submit(Work(job)))
        names.append(running[-1].job_id)
    for each in running:
        each.wait()
    return names
