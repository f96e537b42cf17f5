"""The paper's Table 3: the effect of each part of rewiring, added to FT-L2.

The paper starts from FT-L2 and adds the parts. So the rows without alignment hold the
weights near the previous weights, as FT-L2 does, with its published coefficient. SAC-N
is also trained, because scores are divided by its performance.
"""

from dataclasses import dataclass

import rewire_jax
from experiments import averages, suite
from rewire_jax.reports import paper_results

# By name of the run: marks for rewiring ("*": without caching), multi-mode and
# alignment.
ROWS = {
    "ft_l2": ("", "", ""),
    "rewire-uncached": ("*", "", ""),
    "rewire-cached": ("✓", "", ""),
    "rewire-modes": ("✓", "✓", ""),
    "rewire-aligned": ("✓", "", "✓"),
    "rewire": ("✓", "✓", "✓"),
}


@dataclass(frozen=True, kw_only=True)
class Table3(suite.Experiment):
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
        "rewire-uncached": ("rewire", {"caching": False} | single | unaligned),
        "rewire-cached": ("rewire", single | unaligned),
        "rewire-modes": ("rewire", unaligned),
        "rewire-aligned": ("rewire", single),
        "rewire": ("rewire", {}),
    }


def run(job: Table3) -> None:
    """Trains what is unfinished, and writes the table; raises as `suite.train`."""
    out = job.folder("table3")
    runs = suite.train(job.runs(job.scenario, variants(job)), job)
    reports = suite.reports(runs, out)
    found = averages.over_scenarios(reports)
    head = ["rewire", "multi-mode", "alignment", "performance", "model size", "paper"]
    table, rows = [head], []
    for name, marks in ROWS.items():
        ours, paper = found.get(name), paper_results.ABLATION[name]
        cells = averages.text(ours), averages.size(ours), averages.text(paper)
        table.append([*marks, *cells])
        row = {"run": name} | averages.columns("", ours)
        rows.append(row | averages.columns("paper_", paper))
    notes = (
        averages.READING,
        "",
        "\\*: without caching. Rows without alignment hold the weights near the "
        "previous ones, with FT-L2's coefficient. The paper's are of "
        "halfcheetah/forgetting.",
        "",
        *suite.origins(reports),
    )
    title = f"Table 3 on {job.scenario}, {job.profile} profile"
    suite.write(out / "table3", title, table, notes, rows)


if __name__ == "__main__":
    suite.command(Table3, run, "table3_ablation")
