"""What is done of a campaign, and how long the rest takes."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from rewire_jax.core.errors import UserError
from rewire_jax.run.campaign_file import read_campaign
from rewire_jax.run.campaign_jobs import Job, folder_of, jobs_of
from rewire_jax.run.campaign_population import grouped
from rewire_jax.storage.result_files import read_timing


@dataclass(frozen=True)
class Status:
    """What is done of a campaign.

    Attributes:
      done: names of the finished runs.
      running: names of the runs that a process trains now.
      failed: runs that are set aside, and why.
      missing: names of the others.
      hours: estimate of the remaining hours of training, of all runs together; None
        while no run is finished.
    """

    done: tuple[str, ...]
    running: tuple[str, ...]
    failed: dict[str, str]
    missing: tuple[str, ...]
    hours: float | None

    def __str__(self) -> str:
        """A few lines for a terminal."""
        total = len(self.done + self.running + self.missing) + len(self.failed)
        lines = [f"{len(self.done)} of {total} runs finished"]
        lines += [f"running: {name}" for name in self.running]
        lines += [f"failed: {name}: {reason}" for name, reason in self.failed.items()]
        lines += [f"missing: {name}" for name in self.missing]
        if not self.hours:
            return "\n".join(lines)
        left = timedelta(hours=math.ceil(self.hours * 3600) / 3600)
        lines.append(f"the rest takes about {left} of training, run after run")
        return "\n".join(lines)


def campaign_status(file: str | Path, out: str | Path | None = None) -> Status:
    """The status of a campaign, from its file and its folder.

    Args:
      file: TOML file of the campaign.
      out: folder of the campaign; by default `runs/` and the name of the file.

    Raises:
      UserError: something in the file is wrong, or a folder holds another run.
    """
    made = read_campaign(file)
    root = folder_of(made, out)
    return status(jobs_of(root, grouped(made, root)))


def status(jobs: Sequence[Job]) -> Status:
    """The status of the jobs of a campaign."""
    found: dict[str, list[Job]] = defaultdict(list)
    failed = {}
    for job in jobs:
        reason = job.reason
        if job.done:
            found["done"].append(job)
        elif job.running:
            found["running"].append(job)
        elif reason is not None:
            failed[job.run.name] = reason
        else:
            found["missing"].append(job)
    names = {kind: tuple(job.run.name for job in some) for kind, some in found.items()}
    return Status(
        done=names.get("done", ()),
        running=names.get("running", ()),
        failed=failed,
        missing=names.get("missing", ()),
        hours=hours_left(found["done"], found["running"] + found["missing"]),
    )


def hours_left(done: Sequence[Job], rest: Sequence[Job]) -> float | None:
    """Hours of training that the rest takes, None without a finished run.

    The time of an interaction is that of finished runs: of the same configuration if
    there are any, else of the same scenario, else of all.
    """
    known: dict[tuple[str, ...], list[float]] = defaultdict(list)
    for job in done:
        for key in _keys(job):
            known[key].append(_hours(job) / _interactions(job))
    if not done:
        return None
    left = 0.0
    for job in rest:
        key = next(key for key in _keys(job) if key in known or not key)
        times = known[key]
        expected = sum(times) / len(times) * _interactions(job)
        left += max(expected - _hours(job), 0.0)
    return left


def _keys(job: Job) -> list[tuple[str, ...]]:
    """What a job's time is known by, the best first."""
    scenario = job.run.settings.scenario
    return [(scenario, job.run.configuration), (scenario,), ()]


def _interactions(job: Job) -> int:
    settings = job.run.settings
    return settings.tasks * settings.interactions * settings.seeds


def _hours(job: Job) -> float:
    """Hours that a job has trained; 0 if its file is missing or damaged."""
    settings = job.run.settings
    path = job.folder / "timing.jsonl"
    try:
        return read_timing(
            path, range(settings.tasks), settings.seeds, needed=False
        ).hours
    except UserError:
        return 0.0
