"""The main job: methods on one Brax scenario, with a table and pictures at the end.

Run by `make bench-brax`. A method whose run is finished is not run again, and one
that was stopped goes on, so the same command can be given until all is done.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

import rewire_jax
from rewire_jax.errors import UserError
from rewire_jax.methods import METHODS
from rewire_jax.report import to_terminal
from rewire_jax.rundata import read_run
from rewire_jax.runfolder import HEADER


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What to run.

    Attributes:
      scenario: name of the scenario.
      methods: names of the methods, run one after the other; "all" for every one.
      profile: "quick" or "paper".
      seeds: members of each run; 0 takes the profile's.
      seed: of the first member.
      interactions: of training for each task; 0 takes the profile's.
      backend: physics backend.
      out: folder for runs and report; named after scenario and profile if not given.
      keep: also put the report under experiments/results, to be committed.
    """

    scenario: str = "halfcheetah/forgetting"
    methods: tuple[str, ...] = ("rewire", "ft1")
    profile: str = "quick"
    seeds: int = 1
    seed: int = 0
    interactions: int = 0
    backend: str = "positional"
    out: Path | None = None
    keep: bool = False


def run(bench: Bench) -> None:
    """Trains each method where that is not done, and reports on all.

    Raises:
      UserError: wrong arguments.
      rewire_jax.Stopped: interrupted; the same command goes on.
    """
    name = f"{bench.scenario.replace('/', '-')}-{bench.profile}"
    if bench.interactions:
        name += f"-{bench.interactions}"
    out = bench.out or Path("runs") / name
    scenario = rewire_jax.make_scenario(bench.scenario, bench.backend)
    # Wrong names are found before the first method has run for hours.
    names = METHODS if "all" in bench.methods else bench.methods
    plans = {
        method: rewire_jax.preset(scenario, method, bench.profile)
        for method in dict.fromkeys(names)
    }
    folders = []
    for method, settings in plans.items():
        folder = out / method
        started = (folder / HEADER).exists()
        folders.append(folder)
        if started and read_run(folder).complete:
            print(f"{folder}: finished before, not run again", file=sys.stderr)
            continue
        rewire_jax.train(
            replace(
                settings,
                seeds=bench.seeds,
                seed=bench.seed,
                interactions=bench.interactions or settings.interactions,
            ),
            folder,
            scenario=scenario,
            resume=started,
        )
    print(to_terminal(rewire_jax.write_report(folders, out)))
    if bench.keep:
        rewire_jax.write_report(folders, Path("experiments/results") / name)
    for folder in folders:
        print(f"checkpoints: {folder / 'checkpoints'}")


def main() -> None:
    """Reads the command line; exits with 2 on a user's error."""
    try:
        run(tyro.cli(Bench, prog="python -m experiments.bench_brax"))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except rewire_jax.Stopped:
        print("stopped and saved; the same command goes on", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
