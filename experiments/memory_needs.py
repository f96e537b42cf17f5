"""The device memory of a member, by method and number of environments.

Nothing is trained or compiled: `rewire_jax.training.memory_estimate` counts it from
shapes and traces.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import rewire_jax
from experiments import suite
from rewire_jax.reports.paper_results import NAMES
from rewire_jax.training import memory_estimate
from rewire_jax.training.run_setup import prepare

SCENARIOS = ("halfcheetah/forgetting", "continual_world/t3")
TITLE = "Memory of a member, in MB"
READING = (
    "Counted for the paper profile before anything is compiled: the learner, the "
    "replay buffer, the environments, temporary arrays of training (work), and "
    "temporary arrays of an evaluation. The total is the learner and the larger of "
    "two sums: buffer, environments and work, or the evaluation. Environments that "
    "are stepped on the host take no memory "
    "of the device."
)
COLUMNS = {
    "scenario": suite.show("scenario"),
    "method": lambda row: NAMES[row["method"]],
    "side by side": suite.show("envs"),
    **{
        part: suite.show(part, ".1f", 1e-6)
        for part in (*memory_estimate.Need._fields, "total")
    },
}


@dataclass(frozen=True, kw_only=True)
class MemoryNeeds:
    """What to count.

    Attributes:
      envs: further numbers of environments, for the first method only.
      out: the result files, without a suffix.
    """

    envs: tuple[int, ...] = (64, 256)
    out: Path = suite.RESULTS / "memory-needs"


def count(scenario: rewire_jax.Scenario, method: str, envs: int = 0) -> dict[str, Any]:
    """A row for a method; `envs` 0 stands for the profile's.

    Args:
      scenario: that is learned.
      method: its name.
      envs: environments of a member.
    """
    settings = replace(rewire_jax.preset(scenario, method), seeds=1)
    settings = replace(settings, envs=envs or settings.envs)
    need = memory_estimate.need(prepare(settings, scenario))
    return {
        "scenario": scenario.name,
        "method": method,
        "envs": settings.envs,
        **need._asdict(),
        "total": need.total,
    }


def rows(envs: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Every method of the paper with the profile's environments, rewire with others."""
    for name in SCENARIOS:
        scenario = rewire_jax.make_scenario(name)
        for method in NAMES:
            yield count(scenario, method)
        for number in envs:
            yield count(scenario, "rewire", number)


def run(job: MemoryNeeds) -> None:
    """Counts all and writes it."""
    made = list(rows(job.envs))
    suite.write(job.out, TITLE, suite.table(made, COLUMNS), (READING,), made)


if __name__ == "__main__":
    suite.command(MemoryNeeds, run, "memory_needs")
