"""Whole loops of a population, by the number of its members."""

from matplotlib.axes import Axes

from experiments import population
from experiments.speed.part import Effort, Part, Row, show
from rewire_jax import figures

MEMBERS = (1, 8, 32, 128)


def measure(effort: Effort) -> list[Row]:
    """A row for each number of members, from a process of its own."""
    job = population.Population(rounds=min(effort.rounds, 3), steps=2)
    if effort.quick:
        job = population.Population(
            scenario=effort.scenario, rounds=2, steps=1, members=(2,)
        )
    members = job.members if effort.quick else MEMBERS
    rows = [population.apart(job, count) for count in members]
    for row in rows:
        row["interactions_per_second"] = 1 / row["seconds"]
        row["gain"] = rows[0]["seconds"] / row["seconds"]
    return rows


def draw(axes: Axes, rows: list[Row]) -> None:
    """Interactions a second of all members together."""
    members = [row["members"] for row in rows]
    rates = [row["interactions_per_second"] for row in rows]
    axes.plot(members, rates, marker="o", **figures.look(0))
    axes.set_xscale("log", base=2)
    axes.set_xticks(members, [str(count) for count in members])
    axes.set_ylim(0, None)
    axes.set_xlabel("members side by side")
    axes.set_ylabel("interactions a second, all together")


PART = Part(
    title="Members side by side",
    reading="Interactions with all their updates, rewire, the quick profile's sizes "
    "(width 128, an update for every second interaction). Each number of members is "
    "measured in a process of its own, so the ratios are not of the same rounds; "
    "`experiments.population` says more.",
    measure=measure,
    columns={
        "members": show("members", "d"),
        "interactions a second, all together": show("interactions_per_second", ",.0f"),
        "gain over the first": show("gain", ".2f"),
        "compile, s": show("compile_seconds", ".0f"),
    },
    picture=("Interactions a second by members", draw),
)
