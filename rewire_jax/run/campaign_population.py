"""Whether a campaign trains the seeds of a configuration as one population.

Both ways are measured once, on a few chunks of the first configuration. population.json
in the campaign's folder keeps the figures.
"""

import shutil
import sys
import time
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from rewire_jax.core.arguments import require
from rewire_jax.core.errors import UserError
from rewire_jax.run.campaign_file import Campaign, PlannedRun, as_populations
from rewire_jax.run.campaign_jobs import start
from rewire_jax.storage import run_folder
from rewire_jax.storage.json_lines import document, reading
from rewire_jax.storage.result_files import read_timing

_CHUNKS = 5  # of which the first compiles
_POLL = 1.0  # seconds, to wait for another process
NAME = "population.json"


def grouped(campaign: Campaign, root: Path) -> list[PlannedRun]:
    """The runs of a campaign as its folder trains them, one for each seed if unknown.

    Raises:
      UserError: the folder's note is damaged, or the file says something else.
    """
    path, asked = root / NAME, campaign.population
    population = asked == "always"
    if path.exists():
        with reading(path):
            population = bool(document(path)["population"])
        kept = "always" if population else "never"
        same = asked in ("auto", kept)
        require(same, f'{path} was decided before: population = "{kept}"; keep it')
    return as_populations(campaign.runs) if population else list(campaign.runs)


def decide(
    campaign: Campaign, root: Path, slots: Sequence[Collection[int]]
) -> list[PlannedRun]:
    """The runs to train; measures first which way is faster, if nobody has said so.

    Args:
      campaign: the campaign.
      root: its folder.
      slots: the cores of each process that would train side by side.

    Raises:
      UserError: as `grouped`.
    """
    path, asked = root / NAME, campaign.population
    while not path.exists():
        with run_folder.claimed(root) as ours:
            if not ours:  # Another process measures.
                time.sleep(_POLL)
                continue
            note: dict[str, Any] = {"population": asked == "always"}
            several = [r for r in as_populations(campaign.runs) if len(r.seeds) > 1]
            if asked == "auto" and several:
                note = measure(several[0], root, slots)
            run_folder.write(path, note)
    return grouped(campaign, root)


def submitted_runs(campaign: Campaign, root: Path) -> list[PlannedRun]:
    """The runs to submit to a cluster: of single seeds, if nobody has said so.

    A machine that submits may differ from those that train, so nothing is measured.

    Raises:
      UserError: as `grouped`.
    """
    if not (root / NAME).exists():
        run_folder.make(root)
        run_folder.write(root / NAME, {"population": campaign.population == "always"})
    return grouped(campaign, root)


def measure(
    run: PlannedRun, root: Path, slots: Sequence[Collection[int]]
) -> dict[str, Any]:
    """Measures a run as a population, and its seeds side by side.

    Returns:
      Interactions per second of both ways, and which is faster.
    """
    folder = root / "measured"
    settings = run.settings
    budget = settings.warmup + _CHUNKS * settings.report_every
    short = {
        "tasks": 1,
        "interactions": min(budget, settings.interactions),
        "checkpoint_every": 0,
    }
    count = len(run.seeds)
    try:
        together = _rate(folder / "together", run.words(**short), [()], count)
        alone = run.words(**short, seeds=1)
        beside = _rate(folder / "beside", alone, slots[:count], 1)
        # With fewer processes than seeds, all of them are busy as long.
        note = {
            "population": together > beside,
            "together": together,
            "side_by_side": beside,
            "unit": "interactions per second",
            "configuration": run.name,
        }
        said = f"{together:,.0f} interactions/s as a population, {beside:,.0f} in "
        said += f"{len(slots[:count])} processes"
    except UserError as error:
        note = {"population": False, "error": str(error)}
        said = f"the population was not measured ({error})"
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    way = "populations" if note["population"] else "single seeds"
    print(f"{said}: training {way}", file=sys.stderr, flush=True)
    return note


def _rate(
    folder: Path, words: list[str], slots: Sequence[Collection[int]], seeds: int
) -> float:
    """Interactions per second of a command, in a process for each set of cores.

    Raises:
      UserError: it failed, or is too short to be measured.
    """
    outs = [folder / str(number) for number in range(len(slots))]
    processes = [
        start([*words, "--out", str(out)], folder / "log.txt", cores)
        for out, cores in zip(outs, slots, strict=True)
    ]
    try:
        ended = [process.wait() for process in processes]
    finally:
        for process in processes:
            process.kill()
    require(not any(ended), f"{' '.join(words)} failed")
    timings = [
        read_timing(out / "timing.jsonl", range(1), seeds, needed=True) for out in outs
    ]
    rates = [timing.rate for timing in timings if timing.rate is not None]
    require(len(rates) == len(outs), "it is too short to be measured")
    return sum(rates)
