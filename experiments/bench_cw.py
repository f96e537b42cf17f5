"""The main benchmark on Continual World: like `bench_brax`; optional forward transfer.

Run by `make bench-cw`.
"""

from dataclasses import dataclass, replace
from pathlib import Path

from experiments import bench_brax, suite


@dataclass(frozen=True, kw_only=True)
class Bench(bench_brax.Bench):
    """What to run.

    Attributes:
      scenario: name of the scenario.
      transfer: also train on each single task, to measure forward transfer.
    """

    scenario: str = "continual_world/t3"
    transfer: bool = False


def single(bench: Bench) -> list[suite.Run]:
    """Returns a run for each single task; there, FT-1 is plain SAC.

    Raises:
      UserError: an unknown scenario, or one whose tasks are none of Continual World's.
    """
    places = bench.scenario_of(bench.scenario).tasks
    names = dict.fromkeys(task.name for task in places[: bench.tasks or len(places)])
    alone, out = replace(bench, tasks=0), bench.out or Path("runs")
    scenarios = [bench.scenario_of(f"continual_world/{name}") for name in names]
    return [alone.run(s, "ft1", out / alone.name(s.name) / "ft1") for s in scenarios]


def run(bench: Bench) -> None:
    """Trains what is unfinished, and reports on all; raises as `suite.train`."""
    bench_brax.run(bench, single(bench) if bench.transfer else ())


if __name__ == "__main__":
    suite.command(Bench, run, "bench_cw")
