"""Speeds on this machine: updates, environments, whole loops, other implementations.

Run by `make bench-speed`. The results say nothing about other machines. Compared
programs are timed in turn, in several rounds; see `experiments.speed.timing`.
"""

import json
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from experiments import suite
from experiments.speed import (
    environments,
    loops,
    members,
    permutation,
    sizes,
    startup,
    update_kernels,
    updates,
)
from experiments.speed.part import Effort, Part
from rewire_jax.core.arguments import require
from rewire_jax.reports import plots
from rewire_jax.reports.provenance import how_made
from rewire_jax.reports.table import to_markdown
from rewire_jax.storage import run_folder

PARTS: dict[str, Part] = {
    "updates": updates.PART,
    "kernels": update_kernels.PART,
    "sizes": sizes.PART,
    "permutation": permutation.PART,
    "environments": environments.PART,
    "loops": loops.PART,
    "members": members.PART,
    "startup": startup.PART,
}


@dataclass(frozen=True, kw_only=True)
class Bench:
    """How to measure.

    Attributes:
      parts: parts to measure; all if none is named. Results of other parts are kept.
      out: folder of the results; named after the device if not given.
      rounds: how often each loop is timed.
      seconds: approximate duration of each measurement.
      quick: tiny networks and short loops, to check that the program runs.
    """

    parts: tuple[str, ...] = ()
    out: Path | None = None
    rounds: int = 12
    seconds: float = 0.5
    quick: bool = False


def report(results: Mapping[str, Any], folder: Path) -> str:
    """Markdown: a table for each part that was measured; writes their pictures."""
    lines = ["# Speed"]
    for name, part in PARTS.items():
        if name not in results:
            continue
        result, rows = results[name], results[name]["rows"]
        how, load = result["provenance"], result["load"]
        head, *body = suite.table(rows, part.columns)
        lines += ["", f"## {part.title}", "", *to_markdown(head, body)]
        if part.picture:
            title, draw = part.picture
            figure, (axes,) = plots.empty((7.0, 4.2), 1, 1)
            draw(axes, rows)
            axes.grid(color="0.9")
            axes.set_axisbelow(True)
            plots.entitle(figure, title, how["device"])
            figure.savefig(folder / f"{name}.png")
            lines += [f"![{title}]({name}.png)", ""]
        lines += [result["reading"], ""]
        busy = f"load average {load[0]:.1f} before and {load[1]:.1f} after"
        took = f"in {result['seconds']:.0f} s, {busy}"
        lines += [f"Measured {took}, on {how_made(how)}."]
    return "\n".join(lines) + "\n"


def run(bench: Bench) -> dict[str, Any]:
    """Measures, writes the results after each part, and prints its table.

    Raises:
      UserError: wrong arguments, or a measurement failed.
    """
    chosen = bench.parts or tuple(PARTS)
    for name in chosen:
        require(name in PARTS, f"--parts {name}: choose from {', '.join(PARTS)}")
    require(bench.rounds > 0, f"--rounds must be at least 1, not {bench.rounds}")
    require(bench.seconds > 0, f"--seconds must be above 0, not {bench.seconds}")
    effort = Effort(bench.rounds, bench.seconds)
    if bench.quick:
        effort = Effort(2, 0.02, quick=True)
    device = jax.devices()[0].device_kind.lower().replace(" ", "-")
    results = Path("runs") if bench.quick else suite.RESULTS
    folder = bench.out or results / f"speed-{device}"
    run_folder.make(folder)
    path = folder / "result.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    for name in chosen:
        print(f"measuring {name}", flush=True)
        before, began = os.getloadavg()[0], time.perf_counter()
        rows = PARTS[name].measure(effort)
        found[name] = {
            "rows": rows,
            "seconds": time.perf_counter() - began,
            "load": [before, os.getloadavg()[0]],
            "rounds": effort.rounds,
            # What was measured then, whatever is measured now.
            "reading": PARTS[name].reading,
            "provenance": run_folder.provenance(),
        }
        run_folder.write(path, found)
        text = report(found, folder)
        (folder / "report.md").write_text(text, encoding="utf-8")
    print(text, folder, sep="\n")
    return found


if __name__ == "__main__":
    suite.command(Bench, run, "bench_speed")
