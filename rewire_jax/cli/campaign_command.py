"""The command `rewire-jax campaign`; its docstring is the help text."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rewire_jax.cli.flags import Flags
from rewire_jax.core.formatting import seconds
from rewire_jax.reports.campaign_report import write_campaign_report
from rewire_jax.run.campaign import campaign
from rewire_jax.run.campaign_status import campaign_status
from rewire_jax.run.campaign_submit import Cluster, submit


@dataclass(frozen=True, kw_only=True)
class Campaign(Flags):
    """Trains what is missing of a campaign: many runs, listed in a TOML file.

    The runs are trained side by side, in order of priority. A stopped campaign goes on
    with the same command. A run that fails twice is set aside, and the others go on.
    At the end, the campaign's folder contains a report of the results so far.

    Attributes:
      file: TOML file of the campaign.
      out: folder of the campaign; by default runs/ and the name of the file.
      limit: time after which to save and stop, for example 150m or 2h30m; on a cluster,
        the time limit of a job.
      workers: number of runs trained at the same time; 0 for one for each core, or for
        one if there is an accelerator.
      status: train nothing; print what is finished, running, failed and missing.
      retry: also train runs that were set aside.
      submit: submit each run as a job: to a Slurm cluster, or "local" for this
        machine.
    """

    file: tyro.conf.Positional[Path]
    out: Path | None = None
    limit: Annotated[str | None, tyro.conf.arg(name="for")] = None
    workers: int = 0
    status: tyro.conf.FlagCreatePairsOff[bool] = False
    retry: tyro.conf.FlagCreatePairsOff[bool] = False
    submit: Cluster | None = None

    def __call__(self) -> None:
        """Trains and reports, or submits; then prints the status of the campaign."""
        limit = None if self.limit is None else seconds(self.limit)
        if self.status:
            print(campaign_status(self.file, self.out))
        elif self.submit is not None:
            jobs = submit(
                self.file,
                self.out,
                cluster=self.submit,
                limit=limit,
                workers=self.workers,
                retry=self.retry,
            )
            print(f"submitted jobs: {', '.join(jobs) or 'none'}")
            print(campaign_status(self.file, self.out))
        else:
            folder = campaign(
                self.file,
                self.out,
                limit=limit,
                workers=self.workers,
                retry=self.retry,
            )
            report = write_campaign_report(self.file, folder)
            print(report.data.status, report.page, report.returns, sep="\n")
