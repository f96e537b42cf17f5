"""Keeps the results of a campaign, finished or not, to be committed.

Each scenario of the campaign gets a folder in experiments/results: tables and pictures
as `rewire-jax report` has them, the probabilities of improvement, and the campaign's
two tidy tables. The files of the finished runs are kept there, too, but not their
checkpoints. With --restore, another machine goes on from them.
"""

import dataclasses
import tarfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import rewire_jax
from experiments import suite
from rewire_jax.core.arguments import require
from rewire_jax.reports.campaign_data import read_campaign_data
from rewire_jax.reports.campaign_section import IMPROVEMENT, Section
from rewire_jax.reports.table import to_markdown
from rewire_jax.run.campaign_jobs import Job
from rewire_jax.storage.run_folder import HEADER, TABLES


@dataclass(frozen=True, kw_only=True)
class Kept:
    """What to keep.

    Attributes:
      file: TOML file of the campaign.
      runs: folder of the campaign; by default runs/ and the name of the file.
      restore: first put kept runs into that folder, where it does not have them.
    """

    file: Path
    runs: Path | None = None
    restore: bool = False


def improvement(section: Section) -> list[str]:
    """The probabilities of improvement, in Markdown."""
    heads = ["", *(f"over {label}" for label in section.labels)]
    rows = [
        [label, *("–" if cell is None else str(cell) for cell in row)]
        for label, row in zip(section.labels, section.improvement, strict=True)
    ]
    return [
        "## Probability of improvement",
        "",
        IMPROVEMENT,
        "",
        *to_markdown(heads, rows),
    ]


def archive(job: Job, folder: Path) -> Path:
    """Where the files of a run are kept, in the folder of its campaign's results."""
    return folder / "runs" / f"{job.run.name}.tar.xz"


def keep_runs(jobs: Sequence[Job], folder: Path) -> None:
    """Keeps the files of runs that are not kept yet."""

    def anonymous(info: tarfile.TarInfo) -> tarfile.TarInfo:
        info.mtime = info.uid = info.gid = 0
        info.uname = info.gname = ""
        return info

    for job in jobs:
        path = archive(job, folder)
        if path.exists():
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        with tarfile.open(part, "w:xz") as file:
            for name in (HEADER, *TABLES):
                file.add(job.folder / name, name, filter=anonymous)
        part.rename(path)


def restore_runs(jobs: Sequence[Job], folder: Path) -> None:
    """Puts kept runs where the campaign does not have them."""
    for job in jobs:
        path = archive(job, folder)
        if path.exists() and not job.started:
            part = job.folder.with_name(f".{job.folder.name}.part")
            with tarfile.open(path) as file:
                file.extractall(part, filter="data")
            part.rename(job.folder)


def run(job: Kept) -> None:
    """Writes the folders.

    Raises:
      UserError: the campaign cannot be read, or no run is finished.
    """
    results = suite.RESULTS / f"campaign-{job.file.stem}"
    if job.restore:
        restore_runs(read_campaign_data(job.file, job.runs).jobs, results)
    report = rewire_jax.write_campaign_report(job.file, job.runs)
    data = report.data
    require(bool(report.sections), f"no run of {job.file} is finished")
    tidy = {path.name: path.read_text() for path in (report.returns, report.runs)}
    for number, section in enumerate(report.sections):
        name = "-".join([job.file.stem, *([str(number + 1)] if number else [])])
        kept = dataclasses.replace(
            section.report,
            folder=suite.RESULTS / f"campaign-{name}",
            notes=(*section.unfinished, *section.report.notes),
            texts=section.report.texts | ({} if number else tidy),
            details=[*improvement(section), "## Tasks", "", *section.report.details],
        )
        kept.write()
        print(kept.page)
    keep_runs([each for each in data.jobs if each.run.name in data.finished], results)


if __name__ == "__main__":
    suite.command(Kept, run, "campaign_results")
