"""Writes the report of a campaign: one page, and its numbers as two tidy tables."""

from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import jinja2

from rewire_jax.core.formatting import number
from rewire_jax.reports import own_files
from rewire_jax.reports.campaign_data import (
    CampaignData,
    read_campaign_data,
    returns_csv,
    runs_rows,
)
from rewire_jax.reports.campaign_section import IMPROVEMENT, Section, sections
from rewire_jax.reports.data_files import csv_text
from rewire_jax.reports.table import Table

_STATES = "finished", "running", "failed", "unreadable", "missing"


@dataclass(frozen=True)
class CampaignReport:
    """What `write_campaign_report` wrote.

    Attributes:
        page: the page.
        returns: table with a row for each configuration, scenario, seed, stage, task.
        runs: table with a row for each run.
        data: what is known of the campaign.
        sections: the numbers on the page.
    """

    page: Path
    returns: Path
    runs: Path
    data: CampaignData
    sections: tuple[Section, ...]


def write_campaign_report(
    file: str | Path, out: str | Path | None = None
) -> CampaignReport:
    """Writes the report of a campaign, finished or not, into its folder.

    Args:
        file: TOML file of the campaign.
        out: folder of the campaign; by default `runs/` and the name of the file.

    Raises:
        UserError: something in the file is wrong, a folder holds another run, or `out`
            cannot be written or has files of these names that no report wrote.
    """
    data = read_campaign_data(file, out)
    report = CampaignReport(
        page=data.folder / "report.html",
        returns=data.folder / "returns.csv",
        runs=data.folder / "runs.csv",
        data=data,
        sections=tuple(sections(data)),
    )
    rows = runs_rows(data)
    with own_files.replacing(report.page, (report.returns, report.runs)) as new:
        texts = {
            report.returns: returns_csv(data),
            report.runs: csv_text(rows),
            report.page: to_html(report),
        }
        for path, text in texts.items():
            (new / path.name).write_text(text, encoding="utf-8")
    return report


def to_html(report: CampaignReport) -> str:
    """The page: one file that opens without a network."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rewire_jax.reports", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    data = report.data
    return environment.get_template("campaign.html").render(
        campaign=data.campaign,
        finished=len(data.finished),
        failed=bool(data.status.failed or data.unreadable),
        hours=data.status.hours and number(data.status.hours),
        progress=_progress(data),
        unfinished=_unfinished(data),
        sections=report.sections,
        improvement=IMPROVEMENT,
        runs=_runs(data),
    )


def _progress(data: CampaignData) -> Table:
    """Seeds of each configuration by state."""
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for job in data.jobs:
        key = job.run.settings.scenario, job.run.configuration
        counts[key][data.state(job)] += len(job.run.seeds)
    rows = [
        [*key, *(str(count[state]) for state in _STATES)]
        for key, count in counts.items()
    ]
    return Table(("scenario", "configuration", *_STATES), rows)


def _unfinished(data: CampaignData) -> Table:
    rows = [
        [job.run.name, data.state(job), data.reason(job)]
        for job in data.jobs
        if data.state(job) != "finished"
    ]
    return Table(("run", "state", "reason"), rows)


def _runs(data: CampaignData) -> Table:
    """Where the results come from."""
    heads = "run", "device", "commit", "versions", "started", "command"
    rows = [[str(row[head] or "–") for head in heads] for row in runs_rows(data)]
    return Table(heads, rows)
