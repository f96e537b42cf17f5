"""The paper's Table 2: success rates of all methods on Continual World.

CW3 is the average over eight sequences of three tasks. CW10 is one sequence of ten.
Both use Meta-World v3; the paper used v1.
"""

from dataclasses import dataclass

from experiments import averages, paper_table, suite
from rewire_jax.core.arguments import require
from rewire_jax.reports import paper_results
from rewire_jax.reports.titles import budget
from rewire_jax.storage.scores import SUCCESS, Success

CW10 = "continual_world/cw10"
SCENARIOS = (*(f"continual_world/t{number}" for number in range(1, 9)), CW10)


@dataclass(frozen=True, kw_only=True)
class Table2(paper_table.Table):
    """What to run.

    Attributes:
      scenarios: names of the scenarios.
      methods: names of the methods, or "all".
      success: count an episode as solved if it is solved at any step, or only if it is
        solved at the last step.
    """

    scenarios: tuple[str, ...] = SCENARIOS
    success: Success = "any"


def run(job: Table2) -> None:
    """Trains what is unfinished, and writes the table; raises as `suite.train`."""
    for name in job.scenarios:
        known = f"{SCENARIOS[0]} to {SCENARIOS[-2]} and {CW10}"
        require(name in SCENARIOS, f"Table 2 is of {known}, not of {name}")
    groups = {name: "CW10" if name == CW10 else "CW3" for name in job.scenarios}
    runs = job.runs_of(groups)
    settings = next(iter(runs.values()))[0].settings
    title = (
        f"Table 2 on Meta-World v3, {job.profile} profile, "
        f"{budget(vars(settings))}, reward {settings.reward}, "
        f"{settings.backend} backend"
    )
    score = SUCCESS[job.success]
    (paper,) = paper_results.sources(CW10)
    reading = (
        f"Performance is the {score.noun} after the last task, averaged over tasks. "
        f"{averages.AVERAGED} {score.evaluated} The paper's results are {paper.made}."
    )
    out = job.folder("table2" if job.success == "any" else "table2-last")
    paper_table.write(
        job, runs, "sequences", title, reading, out / "table2", job.success
    )


if __name__ == "__main__":
    suite.command(Table2, run, "table2_continual_world")
