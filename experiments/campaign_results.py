"""Keeps the results of a campaign, finished or not, to be committed.

Each scenario of the campaign gets a folder in experiments/results: tables and pictures
as `rewire-jax report` has them, the probabilities of improvement, and the campaign's
two tidy tables.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import rewire_jax
from experiments import suite
from rewire_jax.core.settings import require
from rewire_jax.reports.campaign_section import IMPROVEMENT, Section
from rewire_jax.reports.table import to_markdown


@dataclass(frozen=True, kw_only=True)
class Kept:
    """What to keep.

    Attributes:
      file: TOML file of the campaign.
      runs: folder of the campaign; by default runs/ and the name of the file.
    """

    file: Path
    runs: Path | None = None


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


def run(job: Kept) -> None:
    """Writes the folders.

    Raises:
      UserError: the campaign cannot be read, or no run is finished.
    """
    report = rewire_jax.write_campaign_report(job.file, job.runs)
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


if __name__ == "__main__":
    suite.command(Kept, run, "campaign_results")
