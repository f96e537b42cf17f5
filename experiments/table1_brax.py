"""The paper's Table 1: performance and model size of all methods on Brax.

All runs are made one after the other, each is resumed where it was stopped. The table
is made from their files alone; with `--no-train` from those that there are.
"""

from dataclasses import dataclass

from experiments import suite
from rewire_jax import published
from rewire_jax.methods import METHODS

SCENARIOS = tuple(name for names in suite.DOMAINS.values() for name in names)


@dataclass(frozen=True, kw_only=True)
class Table1(suite.Experiment):
    """What to run.

    Attributes:
      scenarios: names of the scenarios.
      methods: names of the methods, or "all"; SAC-N, which normalises, is among them
        in any case.
    """

    scenarios: tuple[str, ...] = SCENARIOS
    methods: tuple[str, ...] = ("all",)


def run(job: Table1) -> None:
    """Trains what is not finished, and writes a report a scenario and the table.

    Raises:
      UserError: wrong arguments.
      rewire_jax.Stopped: interrupted; the same command goes on.
    """
    methods = METHODS if "all" in job.methods else ("sac_n", *job.methods)
    variants: suite.Variants = {method: (method, {}) for method in methods}
    domains: dict[str, list[suite.Run]] = {}
    for name in dict.fromkeys(job.scenarios):
        domains.setdefault(name.split("/")[0], []).extend(job.runs(name, variants))
    out = job.folder("table1")
    done = suite.train([run for runs in domains.values() for run in runs], job)
    head, reports, rows = ["method"], [], []
    lines = {method: [published.NAMES.get(method, method)] for method in variants}
    for domain, runs in domains.items():
        made = suite.reports([run for run in runs if run in done], out)
        reports += made
        found = suite.averages(made)
        sources = published.sources(runs[0].settings.scenario)
        head += [domain, "model size", "paper", "paper's model size"]
        for method, line in lines.items():
            ours = found.get(method)
            theirs = sources[0].results.get(method) if sources else None
            line += [
                suite.text(ours, len(runs) // len(variants)),
                suite.size(ours),
                suite.text(theirs),
                suite.size(theirs),
            ]
            rows.append(
                {"domain": domain, "method": method}
                | suite.columns("", ours)
                | suite.columns("paper_", theirs)
            )
    notes = (suite.READING, "", *suite.origins(reports))
    title = f"Table 1, {job.profile} profile"
    suite.write(out / "table1", title, [head, *lines.values()], notes, rows)


if __name__ == "__main__":
    suite.command(Table1, run, "table1_brax")
