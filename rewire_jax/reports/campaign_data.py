"""What the folder of a campaign holds, as two tidy tables."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rewire_jax.core.arguments import require
from rewire_jax.core.errors import UserError
from rewire_jax.reports.data_files import csv_text
from rewire_jax.run.campaign_file import Campaign, read_campaign
from rewire_jax.run.campaign_jobs import Job, folder_of, jobs_of
from rewire_jax.run.campaign_population import grouped
from rewire_jax.run.campaign_status import Status, status
from rewire_jax.run.header_check import check_header
from rewire_jax.storage.result_files import Results, Rows
from rewire_jax.storage.run_results import RunData, read_rows, read_run

_RETURNS = (
    "scenario",
    "configuration",
    "method",
    "seed",
    "stage",
    "task",
    "name",
    "return",
    "success",
    "success_last",
    "diverged",
    "model_size",
    "stored_states",
    "training_interactions",
    "selection_interactions",
    "tuned_on",
)


@dataclass(frozen=True)
class CampaignData:
    """What is known of a campaign.

    Attributes:
        campaign: what its file says.
        folder: its folder.
        jobs: its runs, as they are trained.
        status: which are finished, running, failed, missing.
        evaluated: header and evaluations of the runs that have some, by their name.
        finished: results of the finished runs, by their name.
        unreadable: why the results of a run cannot be read, by its name.
    """

    campaign: Campaign
    folder: Path
    jobs: tuple[Job, ...]
    status: Status
    evaluated: Mapping[str, tuple[Results, Rows]]
    finished: Mapping[str, RunData]
    unreadable: Mapping[str, str]

    def state(self, job: Job) -> str:
        """Whether a run is finished, running, failed, unreadable or missing."""
        name, known = job.run.name, self.status
        if name in self.unreadable:
            return "unreadable"
        states = {"finished": known.done, "running": known.running}
        states |= {"failed": tuple(known.failed)}
        return next((key for key, some in states.items() if name in some), "missing")

    def reason(self, job: Job) -> str:
        """Why a run failed or is unreadable; empty for others."""
        name = job.run.name
        return self.unreadable.get(name) or self.status.failed.get(name, "")

    def tuned(self, scenario: str) -> str:
        """Whether any setting was tuned on a scenario: yes, no or unknown."""
        if self.campaign.tuned_on is None:
            return "unknown"
        return "yes" if scenario in self.campaign.tuned_on else "no"


def read_campaign_data(file: str | Path, out: str | Path | None = None) -> CampaignData:
    """Reads a campaign, finished or not, from its file and its folder.

    Args:
        file: TOML file of the campaign.
        out: folder of the campaign; by default `runs/` and the name of the file.

    Raises:
        UserError: something in the file is wrong, or a folder holds another run.
    """
    campaign = read_campaign(file)
    root = folder_of(campaign, out)
    jobs = tuple(jobs_of(root, grouped(campaign, root)))
    known = status(jobs)
    evaluated, finished, unreadable = {}, {}, {}
    for job in jobs:
        name = job.run.name
        if name not in known.done and not (job.folder / "results.jsonl").exists():
            continue
        try:
            check_header(job.folder)
            evaluated[name] = read_rows(job.folder)
            if name in known.done:
                run = read_run(job.folder)
                require(run.complete, f"{job.folder}/results.jsonl lacks rows")
                finished[name] = run
        except UserError as error:
            evaluated.pop(name, None)
            unreadable[name] = str(error)
    return CampaignData(campaign, root, jobs, known, evaluated, finished, unreadable)


def returns_csv(data: CampaignData) -> str:
    """CSV with a row for each configuration, scenario, seed, stage and task.

    Stage 0 is before training, and stage 1 after training on task 1. The rows do not
    say how the runs were trained, so that they are the same for populations.
    """
    rows = [row for job in data.jobs for row in _returns(data, job)]
    keys = "scenario", "configuration", "seed", "stage", "task"
    rows.sort(key=lambda row: tuple(row[key] for key in keys))
    return csv_text(rows, _RETURNS)


def _returns(data: CampaignData, job: Job) -> list[dict[str, Any]]:
    """Rows of a run."""
    if job.run.name not in data.evaluated:
        return []
    head, found = data.evaluated[job.run.name]
    settings = job.run.settings
    return [
        {
            "scenario": settings.scenario,
            "configuration": job.run.configuration,
            "method": settings.method,
            "seed": settings.seed + member,
            "stage": stage + 1,
            "task": task + 1,
            "name": head.tasks[task],
            "return": row["return"],
            "success": row.get("success"),
            "success_last": row.get("success_last"),
            "diverged": int(row["diverged"]),
            "model_size": row["model_size"],
            "stored_states": row["stored_states"],
            "training_interactions": int(row["training"]),
            "selection_interactions": int(row["selection"]),
            "tuned_on": data.tuned(settings.scenario),
        }
        for (member, stage, task), row in found.items()
    ]


def runs_rows(data: CampaignData) -> list[dict[str, Any]]:
    """A row for each run: its state and where its results come from."""
    rows = []
    for job in sorted(data.jobs, key=lambda job: _place(job)):
        settings, name = job.run.settings, job.run.name
        head = data.evaluated[name][0] if name in data.evaluated else None
        made = head.provenance if head else {}
        versions = made.get("versions", {})
        rows.append(
            {
                "run": name,
                "scenario": settings.scenario,
                "configuration": job.run.configuration,
                "method": settings.method,
                "first_seed": job.run.seeds[0],
                "last_seed": job.run.seeds[-1],
                "profile": settings.profile,
                "backend": settings.backend,
                "interactions": settings.interactions,
                "state": data.state(job),
                "reason": data.reason(job),
                "hours": data.finished[name].hours if name in data.finished else None,
                "device": made.get("device"),
                "commit": made.get("commit"),
                "versions": "; ".join(f"{key} {versions[key]}" for key in versions),
                "started": made.get("started"),
                "command": made.get("command"),
            }
        )
    return rows


def _place(job: Job) -> tuple[str, str, int]:
    return job.run.settings.scenario, job.run.configuration, job.run.settings.seed
