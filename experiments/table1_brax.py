"""The paper's Table 1: performance and model size of all methods on Brax."""

from dataclasses import dataclass

from experiments import averages, paper_table, suite

SCENARIOS = tuple(name for names in suite.DOMAINS.values() for name in names)


@dataclass(frozen=True, kw_only=True)
class Table1(paper_table.Table):
    """What to run.

    Attributes:
      scenarios: names of the scenarios.
      methods: names of the methods, or "all". SAC-N is always included, because scores
        are divided by its performance.
    """

    scenarios: tuple[str, ...] = SCENARIOS


def run(job: Table1) -> None:
    """Trains what is unfinished, and writes the table; raises as `suite.train`."""
    domains = {name: name.split("/")[0] for name in job.scenarios}
    paper_table.write(
        job,
        job.runs_of(domains, always=("sac_n",)),
        "domain",
        f"Table 1, {job.profile} profile",
        averages.READING,
        job.folder("table1") / "table1",
    )


if __name__ == "__main__":
    suite.command(Table1, run, "table1_brax")
