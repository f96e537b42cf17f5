"""What rewiring costs in plain updates, by the number of modes and by width."""

from dataclasses import replace

from matplotlib.axes import Axes

from experiments.speed.part import Effort, Part
from experiments.speed.timing import in_turn
from experiments.speed.updates import METHODS, update_loop
from experiments.suite import Row, show
from rewire_jax.reports import plots

MODES = (1, 3, 5)
WIDTHS = (128, 256, 512, 1024, 2048, 4096)


def measure(effort: Effort) -> list[Row]:
    """A row for each number of modes and width, timed in turn with plain updates."""
    cases = [*((modes, 256) for modes in MODES), *((3, width) for width in WIDTHS)]
    if effort.quick:
        cases = [(2, 8)]
    rows = []
    for modes, width in dict.fromkeys(cases):
        print(f"  K = {modes}, n = {width}", flush=True)
        rewire = effort.settings("rewire", hidden=width)
        options = replace(rewire.options, modes=modes)
        loops = {
            "plain": update_loop(effort.settings(METHODS["plain"], hidden=width)),
            "rewire": update_loop(replace(rewire, options=options)),
        }
        # A round of the wide ones takes long, and is disturbed the less.
        rounds = effort.rounds if width <= 512 else min(effort.rounds, 3)
        timings = in_turn(loops, rounds, effort.seconds)
        row: Row = {"modes": modes, "hidden": width, "batch": rewire.sac.batch_size}
        for name, timing in timings.items():
            row[name] = timing.best
            row[f"{name}_seconds"] = timing.seconds
        row["cost"] = timings["plain"].over(timings["rewire"])
        rows.append(row)
    return rows


def draw(axes: Axes, rows: list[Row]) -> None:
    """Cost by width, at one number of modes."""
    rows = [row for row in rows if row["modes"] == rows[-1]["modes"]]
    rows.sort(key=lambda row: row["hidden"])
    widths = [row["hidden"] for row in rows]
    plots.by_size(axes, widths, [row["cost"] for row in rows])
    axes.set_xlabel("neurons in a hidden layer")
    axes.set_ylabel("cost of a rewire update, in plain ones")


PART = Part(
    title="Rewire over plain updates, by modes and width",
    reading="Updates with the policy at every second one, everything on: K modes, "
    "their distillation, and the alignment with a previous task.",
    measure=measure,
    columns={
        "modes K": show("modes"),
        "width n": show("hidden"),
        "batch": show("batch"),
        "plain, a second": show("plain", ",.3g"),
        "rewire, a second": show("rewire", ",.3g"),
        "cost": show("cost", ".2f"),
    },
    picture=("Cost of rewiring by width, K = 3", draw),
)
