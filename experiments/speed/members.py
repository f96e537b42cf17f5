"""Updates of a population, by the number of its members."""

from matplotlib.axes import Axes

from experiments import population
from experiments.speed.part import Effort, Part
from experiments.suite import Row, show
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.reports import plots
from rewire_jax.training.presets import preset

MEMBERS = (1, 8, 32, 128)
SCENARIO = "probe/reach"


def measure(effort: Effort) -> list[Row]:
    """A row for each number of members, from a process of its own."""
    settings = preset(make_scenario(SCENARIO), "rewire", "quick")
    job = population.Population(
        scenario=SCENARIO, rounds=min(effort.rounds, 5), steps=4
    )
    rows = []
    for members in (2,) if effort.quick else MEMBERS:
        print(f"  {members} members", flush=True)
        row = population.apart(job, members)
        updates = settings.updates / settings.envs / row["seconds"]
        rows.append(row | {"updates_per_second": updates})
    first = rows[0]["updates_per_second"]
    return [row | {"gain": row["updates_per_second"] / first} for row in rows]


def draw(axes: Axes, rows: list[Row]) -> None:
    """Updates a second of all members together."""
    members = [row["members"] for row in rows]
    plots.by_size(axes, members, [row["updates_per_second"] for row in rows])
    axes.set_xlabel("members side by side")
    axes.set_ylabel("updates a second, all together")


PART = Part(
    title="Members side by side",
    reading="Rewire updates of all members together, in training on a probe (a small "
    "test environment whose steps cost almost nothing). Width 128, as in the quick "
    "profile. Each number of members has its own process, so the gains do not compare "
    "the same rounds. `experiments.population` measures the same on HalfCheetah, "
    "and memory.",
    measure=measure,
    columns={
        "members": show("members"),
        "updates a second, all together": show("updates_per_second", ",.0f"),
        "gain over the first": show("gain", ".2f"),
        "compile, s": show("compile_seconds", ".0f"),
    },
    picture=("Updates a second by members", draw),
)
