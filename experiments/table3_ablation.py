"""The paper's Table 3: the effect of each part of rewiring, added to FT-L2.

The paper starts from FT-L2 and adds the parts. So the rows without alignment hold the
weights near the previous weights, as FT-L2 does, with its published coefficient. SAC-N
is also trained, because scores are divided by its performance. With --campaign, the
runs are those of a campaign.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import rewire_jax
from experiments import averages, suite
from rewire_jax.core.errors import UserError
from rewire_jax.reports import paper_results
from rewire_jax.reports.campaign_data import read_campaign_data
from rewire_jax.reports.campaign_section import sections
from rewire_jax.reports.provenance import origin
from rewire_jax.reports.report import Report
from rewire_jax.reports.run_summary import Comparison, Summary
from rewire_jax.run.campaign_file import slug

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


def report(job: Table3, out: Path) -> tuple[Report[Comparison], dict[str, Summary]]:
    """The report on the runs, trained or of the campaign, and its rows by name.

    Raises:
      UserError: as `suite.train` does; or the campaign has no finished run for this.
    """
    if job.campaign is None:
        runs = suite.train(job.runs(job.scenario, variants(job)), job)
        (made,) = suite.reports(runs, out)
        names = [summary.run.folder.name for summary in made.numbers.summaries]
        return made, dict(zip(names, made.numbers.summaries, strict=True))
    for section in sections(read_campaign_data(job.campaign, job.trained_in)):
        names = [slug(name) for name in section.names]
        found = dict(zip(names, section.report.numbers.summaries, strict=True))
        scenario = found[names[0]].run.settings["scenario"]
        if scenario == job.scenario and "sac_n" in found:
            notes = (*section.unfinished, *section.report.notes)
            return replace(section.report, notes=notes), found
    raise UserError(
        f"{job.campaign} has no finished run of SAC-N on {job.scenario}, by which "
        "scores are divided"
    )


def run(job: Table3) -> None:
    """Trains what is unfinished, and writes the table; raises as `report`."""
    out = job.folder("table3")
    made, found = report(job, out)
    shown = {} if made.numbers.raw else found
    head = ["rewire", "multi-mode", "alignment", "performance", "IQM [95% interval]"]
    table, rows = [[*head, "model size", "seeds", "paper"]], []
    for name, marks in ROWS.items():
        ours, paper = shown.get(name), paper_results.ABLATION[name]
        if ours and not (ours.run.complete and ours.performance.values):
            ours = None
        table.append([*marks, *cells(ours), averages.text(paper)])
        row = {"run": name} | columns(ours)
        rows.append(row | averages.columns("paper_", paper))
    used = [found[name] for name in ("sac_n", *ROWS) if name in found]
    notes = [f"**{note}**" for note in made.notes]
    notes += ["", READING, "", *(origin(each.label, each.run) for each in used)]
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
