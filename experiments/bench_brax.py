"""The main benchmark: methods on one Brax scenario, with a table and plots at the end.

Run by `make bench-brax`. It skips methods whose run is finished and continues stopped
runs, so you can repeat the command until everything is finished.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import rewire_jax
from experiments import suite
from rewire_jax.core.arguments import require
from rewire_jax.reports.paper_results import NAMES
from rewire_jax.reports.report import to_terminal


@dataclass(frozen=True, kw_only=True)
class Bench(suite.Job):
    """What to run.

    Attributes:
      scenario: name of the scenario.
      methods: names of the methods, run one after the other; "all" for those of the
        paper.
      out: folder for runs and report; by default named after scenario and profile.
      keep: also write the report to experiments/results, to be committed.
    """

    scenario: str = "halfcheetah/forgetting"
    methods: tuple[str, ...] = ("rewire", "ft1")
    out: Path | None = None
    keep: bool = False


def run(bench: Bench, single: Sequence[suite.Run] = ()) -> None:
    """Trains each method where that is not done, and reports on all.

    Args:
      bench: what to run.
      single: runs of one task each, from which forward transfer is measured once all
        of them are finished.

    Raises:
      UserError: wrong arguments.
      rewire_jax.Stopped: interrupted; the same command continues.
    """
    name = bench.name(bench.scenario)
    out = bench.out or Path("runs") / name
    scenario = bench.scenario_of(bench.scenario)
    methods = NAMES if "all" in bench.methods else dict.fromkeys(bench.methods)
    runs = [bench.run(scenario, method, out / method) for method in methods]
    done = suite.train([*runs, *single], bench)
    folders = [run.folder for run in runs if run in done]
    require(bool(folders), "none of the methods has results yet")
    alone = [run.folder for run in single if run.finished]
    if len(alone) < len(single):
        print("no forward transfer before all single-task runs end", file=sys.stderr)
        alone = []
    print(to_terminal(rewire_jax.write_report(folders, out, single=alone)))
    if bench.keep:
        rewire_jax.write_report(folders, suite.RESULTS / name, single=alone)
    for folder in folders:
        print(f"checkpoints: {folder / 'checkpoints'}")


if __name__ == "__main__":
    suite.command(Bench, run, "bench_brax")
