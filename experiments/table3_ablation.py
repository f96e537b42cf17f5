"""The paper's Table 3: the effect of each part of rewiring, added to FT-L2.

The paper starts from FT-L2 and adds the parts. So the rows without alignment hold the
weights near the previous weights, as FT-L2 does, with its published coefficient. SAC-N
is also trained, because scores are divided by its performance. With --campaign, the
runs are those of a campaign.
"""

from dataclasses import dataclass
from pathlib import Path

import rewire_jax
from experiments import averages, suite
from rewire_jax.core.arguments import require
from rewire_jax.reports import paper_results
from rewire_jax.reports.provenance import origin
from rewire_jax.reports.report import Report
from rewire_jax.reports.run_summary import Comparison, Summary

READING = (
    "Performance is the return after the last task, averaged over tasks and divided by "
    "that of SAC-N: mean ± standard deviation over seeds. IQM is the interquartile "
    "mean over tasks and seeds. Unfinished runs are left out. \\*: without caching. "
    "Rows without alignment hold the weights near the previous ones, with FT-L2's "
    "coefficient. The paper's results are of halfcheetah/forgetting on Brax v1."
)
# By name of the run: marks for rewiring ("*": without caching), multi-mode and
# alignment.
ROWS = {
    "ft_l2": ("", "", ""),
    "rewire-without-caching-modes-alignment": ("*", "", ""),
    "rewire-without-modes-alignment": ("✓", "", ""),
    "rewire-without-alignment": ("✓", "✓", ""),
    "rewire-without-modes": ("✓", "", "✓"),
    "rewire": ("✓", "✓", "✓"),
}


@dataclass(frozen=True, kw_only=True)
class Table3(suite.OfCampaign):
    """What to run.

    Attributes:
      scenario: name of the scenario.
    """

    scenario: str = "halfcheetah/forgetting"


def variants(job: Table3) -> suite.Variants:
    """Methods and their options by the name of the run."""
    scenario = job.scenario_of(job.scenario)
    plain = rewire_jax.preset(scenario, "ft_l2", job.profile).options
    unaligned = {"alignment": "off", "beta": plain.coefficient}
    single = {"modes": 1}
    return {
        "sac_n": ("sac_n", {}),
        "ft_l2": ("ft_l2", {}),
        "rewire-without-caching-modes-alignment": (
            "rewire",
            {"caching": False} | single | unaligned,
        ),
        "rewire-without-modes-alignment": ("rewire", single | unaligned),
        "rewire-without-alignment": ("rewire", unaligned),
        "rewire-without-modes": ("rewire", single),
        "rewire": ("rewire", {}),
    }


def report(job: Table3, out: Path) -> Report[Comparison]:
    """The runs, trained or of the campaign, as their report has them.

    Raises:
      UserError: as `suite.train` does; or no run of the campaign is finished.
    """
    if job.campaign is None:
        runs = suite.train(job.runs(job.scenario, variants(job)), job)
        return suite.reports(runs, out)[0]
    sections = rewire_jax.write_campaign_report(job.campaign, job.trained_in).sections
    found = [
        section.report
        for section in sections
        if section.report.numbers.summaries[0].run.settings["scenario"] == job.scenario
    ]
    require(bool(found), f"no run of {job.campaign} on {job.scenario} is finished")
    return found[0]


def run(job: Table3) -> None:
    """Trains what is unfinished, and writes the table; raises as `report`."""
    out = job.folder("table3")
    made = report(job, out)
    require(not made.numbers.raw, "no run of SAC-N is finished, and scores need it")
    found = {
        summary.run.folder.name: summary
        for summary in made.numbers.summaries
        if summary.run.complete and summary.performance.values
    }
    head = ["rewire", "multi-mode", "alignment", "performance", "IQM [95% interval]"]
    table, rows = [[*head, "model size", "seeds", "paper"]], []
    for name, marks in ROWS.items():
        ours, paper = found.get(name), paper_results.ABLATION[name]
        table.append([*marks, *cells(ours), averages.text(paper)])
        row = {"run": name} | columns(ours)
        rows.append(row | averages.columns("paper_", paper))
    notes = (
        READING,
        "",
        *(origin(found[name].label, found[name].run) for name in ROWS if name in found),
    )
    suite.write(out / "table3", f"Table 3 on {made.title}", table, notes, rows)


def cells(ours: Summary | None) -> list[str]:
    """A row's results as the table shows them."""
    if ours is None:
        return ["–"] * 4
    seeds = str(int(ours.run.kept.sum()))
    return [str(ours.performance), str(ours.iqm), f"{ours.run.model_size:.2f}", seeds]


def columns(ours: Summary | None) -> suite.Row:
    """The same as numbers."""
    return {
        "performance": ours and ours.performance.mean,
        "performance_std": ours and ours.performance.std,
        "iqm": ours and ours.iqm.value,
        "iqm_low": ours and ours.iqm.low,
        "iqm_high": ours and ours.iqm.high,
        "model_size": ours and ours.run.model_size,
        "seeds": ours and int(ours.run.kept.sum()),
    }


if __name__ == "__main__":
    suite.command(Table3, run, "table3_ablation")
