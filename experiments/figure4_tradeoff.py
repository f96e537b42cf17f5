"""The paper's Figure 4: performance and model size on the HalfCheetah scenarios.

It also has CSP-S, with narrower policies, and Ours-L, with a wider policy. In the
paper their widths are 175 and 384 instead of 256; here they are scaled to the profile's
networks.
"""

from dataclasses import dataclass

import rewire_jax
from experiments import averages, suite
from rewire_jax.reports import paper_results
from rewire_jax.reports.tradeoff_plot import Point, tradeoff

SIZED = {"CSP-S": ("csp", 175 / 256), "Ours-L": ("rewire", 384 / 256)}


@dataclass(frozen=True, kw_only=True)
class Figure4(suite.Experiment):
    """What to run.

    Attributes:
      scenarios: names of the scenarios.
    """

    scenarios: tuple[str, ...] = suite.DOMAINS["halfcheetah"]


def variants(job: Figure4, name: str) -> suite.Variants:
    """Methods and their options by the name of the run."""
    scenario = job.scenario_of(name)
    chosen: suite.Variants = {method: (method, {}) for method in paper_results.NAMES}
    for label, (method, factor) in SIZED.items():
        hidden = rewire_jax.preset(scenario, method, job.profile).sac.hidden
        chosen[label.lower()] = method, {"width": round(factor * hidden)}
    return chosen


def run(job: Figure4) -> None:
    """Trains what is unfinished, and draws it; raises as `suite.train`."""
    out = job.folder("figure4")
    runs = [r for name in job.scenarios for r in job.runs(name, variants(job, name))]
    reports = suite.reports(suite.train(runs, job), out)
    found = averages.over_scenarios(reports)
    labels = paper_results.NAMES | {label.lower(): label for label in SIZED}
    table, rows, points = [["method", "performance", "model size"]], [], []
    for name, label in labels.items():
        ours = found.get(name)
        shown = averages.text(ours, len(job.scenarios))
        table.append([label, shown, averages.size(ours)])
        rows.append({"method": label} | averages.columns("", ours))
        if ours:
            points.append(Point(label, ours.size, ours.mean, ours.std))
    title = f"Figure 4, {', '.join(job.scenarios)}, {job.profile} profile"
    picture = out / "figure4.png"
    notes = (f"![{title}]({picture.name})", "", averages.READING, "")
    suite.write(out / "figure4", title, table, (*notes, *suite.origins(reports)), rows)
    tradeoff(points, "÷ SAC-N", title, picture)
    print(picture)


if __name__ == "__main__":
    suite.command(Figure4, run, "figure4_tradeoff")
