"""Writes the report of runs, or of a sweep, only from their files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rewire_jax.core.arguments import require
from rewire_jax.reports import run_report, sweep_report
from rewire_jax.reports.report import Report
from rewire_jax.reports.run_summary import summarize
from rewire_jax.reports.sweep_summary import summarize_sweep
from rewire_jax.run.header_check import check_header
from rewire_jax.storage import run_folder
from rewire_jax.storage.run_results import read_run
from rewire_jax.storage.scores import SUCCESS, Success
from rewire_jax.storage.sweep_results import read_sweep


def write_report(
    folders: Sequence[str | Path] | str | Path,
    out: str | Path,
    *,
    single: Sequence[str | Path] = (),
    success: Success = "any",
) -> Report[Any]:
    """Writes the report of comparable runs, or of one sweep, finished or not.

    Runs that know success are measured by their success rates, others by returns.

    Args:
        folders: folders of the runs, or of the sweep; or one folder.
        out: the folder to write into; made where missing, an old report is replaced.
        single: folders of finished runs that learn one task each, one for every task
            of the sequence: forward transfer of success rates is measured from them.
        success: steps of an episode that count: "any", or only the "last".

    Returns:
        The report, whose `numbers` are a `Comparison` or a `SweepSummary`.

    Raises:
        UserError: a folder cannot be read or has no results yet, the runs are not
            comparable, a task lacks its single-task run, or `out` cannot be written or
            has files of these names that no report wrote.
    """
    folders, single = (
        [some] if isinstance(some, str | Path) else list(some)
        for some in (folders, single)
    )
    known = ", ".join(SUCCESS)
    require(success in SUCCESS, f"unknown success {success!r}: choose one of {known}")
    for folder in (*folders, *single):
        check_header(Path(folder))
    report: Report[Any]
    if "sweep" in [run_folder.kind(Path(folder)) for folder in folders]:
        require(len(folders) == 1 and not single, "a sweep has a report of its own")
        report = sweep_report.make(summarize_sweep(read_sweep(folders[0])), Path(out))
    else:
        comparison = summarize(
            [read_run(folder, success) for folder in folders],
            [read_run(folder, success) for folder in single],
        )
        report = run_report.make(comparison, Path(out))
    report.write()
    return report
