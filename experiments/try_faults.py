"""Faults of many kinds, each tried on the real command, and what they cost.

Run by `make faults`. Every case should end in one clear line, or go on to the result
that it has when nothing goes wrong; nothing that was finished may be lost.
"""

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments import suite
from experiments.faults import (
    damage,
    disk,
    folders,
    hostile,
    kills,
    mistakes,
    signals,
    surprises,
    versions,
)
from experiments.faults.base import Impossible, Kind
from rewire_jax.core.settings import require
from rewire_jax.reports.table import to_markdown
from rewire_jax.storage import run_folder

KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        *kills.KINDS,
        *signals.KINDS,
        *folders.KINDS,
        *versions.KINDS,
        *surprises.KINDS,
        *damage.KINDS,
        *disk.KINDS,
        *mistakes.KINDS,
        *hostile.KINDS,
    )
}
READING = (
    "Every case runs the command in a process of its own, on small runs. It is as it "
    "should be if it ends in one clear line without a traceback, or goes on to the "
    "same final result, bit for bit, as a run to which nothing happened. Results are "
    "rows of evaluations and of training, and the arrays that are kept of a task."
)


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What to try.

    Attributes:
      kinds: of faults; all if none is named. What is known of the others is kept.
      out: the result files, without a suffix.
    """

    kinds: tuple[str, ...] = ()
    out: Path = suite.RESULTS / "faults"


def attempt(kind: Kind, folder: Path) -> list[dict[str, Any]]:
    """Tries all cases of a kind, each in a folder of its own in this one."""
    rows = []
    for number, case in enumerate(kind.cases):
        place = folder / f"{kind.name}-{number}"
        place.mkdir()
        try:
            came = case.run(place)
        except Impossible as why:
            print(f"{kind.name}, {case.name}: not tried, {why}", flush=True)
            continue
        told = came._replace(
            said=came.said.replace(f"{folder}/", ""),
            wrong=came.wrong.replace(f"{folder}/", ""),
        )
        rows.append({"case": case.name, "ok": came.ok, **told._asdict()})
        print(f"{kind.name}, {case.name}: {came.wrong or 'ok'}", flush=True)
    return rows


def report(found: Mapping[str, Any]) -> str:
    """Markdown: a line for each kind, and where it comes from."""
    head = ["fault", "cases tried", "as they should be", "results lost"]
    lines = []
    for name, kind in KINDS.items():
        if name in found:
            rows = found[name]["cases"]
            sums = [sum(row[part] for row in rows) for part in ("ok", "lost")]
            lines.append([kind.title, str(len(rows)), *map(str, sums)])
    origins = []
    for name in filter(KINDS.__contains__, found):
        how = found[name]["provenance"]
        origins += [f"- {name}: {how['device']}, commit `{how['commit']}`"]
    table = to_markdown(head, lines)
    return "\n".join(["# Faults", "", *table, READING, "", *origins]) + "\n"


def run(job: Faults) -> None:
    """Tries the kinds, one after the other, and writes after each.

    Raises:
      UserError: there is no such kind.
    """
    for name in job.kinds:
        require(name in KINDS, f"--kinds {name}: choose from {', '.join(KINDS)}")
    run_folder.make(job.out.parent)
    path = job.out.with_suffix(".json")
    found = json.loads(path.read_text()) if path.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        for name in job.kinds or KINDS:
            cases = attempt(KINDS[name], Path(folder))
            found[name] = {"cases": cases, "provenance": run_folder.provenance()}
            run_folder.write(path, found)
            text = report(found)
            job.out.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    suite.command(Faults, run, "try_faults")
