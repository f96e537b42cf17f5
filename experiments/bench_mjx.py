"""Environment steps a second of Meta-World on MJX-Warp, by number of environments.

Run by `make bench-mjx`. Rates are those of the best round; actions are random.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import tyro

from rewire_jax.envs.base import Environment, TaskChange
from rewire_jax.envs.metaworld import make_domain
from rewire_jax.reports.run_tables import markdown
from rewire_jax.storage.run_folder import provenance

HEADS = ("task", "environments", "steps/s", "reset s", "kB/environment")


@dataclass(frozen=True, kw_only=True)
class BenchMjx:
    """What to measure.

    Attributes:
      tasks: names of the tasks, together in one domain.
      environments: numbers of parallel environments.
      steps: of every environment, in one compiled loop.
      rounds: how often each loop is timed.
      out: result file; a Markdown table is written beside it.
    """

    tasks: tuple[str, ...] = ("window-close", "push")
    environments: tuple[int, ...] = (1, 64, 1024)
    steps: int = 100
    rounds: int = 3
    out: Path | None = None


def timed(rounds: int, function: Callable[..., Any], *arguments: Any) -> list[Any]:
    """What a function gives, and the seconds of each of some further calls."""
    result = jax.block_until_ready(function(*arguments))
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - start)
    return [result, *seconds]


def measure(job: BenchMjx, count: int) -> list[dict[str, Any]]:
    """Times resets and steps of one number of environments, on each task."""
    domain = make_domain("mjx", "v2", job.tasks)
    environment = domain.environment
    assert isinstance(environment, Environment)

    @jax.jit
    def reset(task, keys):
        return jax.vmap(lambda key: environment.reset(task, key))(keys)

    @jax.jit
    def play(task, state, key):
        def step(state, key):
            shape = (count, environment.action_size)
            actions = jax.random.uniform(key, shape, minval=-1.0)
            one = jax.vmap(lambda state, action: environment.step(task, state, action))
            return one(state, actions), None

        return jax.lax.scan(step, state, jax.random.split(key, job.steps))[0]

    keys = jax.random.split(jax.random.key(0), count)
    rows = []
    for name in job.tasks:
        task = domain.make_task(TaskChange(name, extra={"task": name}))
        state, *resets = timed(job.rounds, reset, task, keys)
        _, *plays = timed(job.rounds, play, task, state, keys[0])
        rows.append(
            {
                "task": name,
                "environments": count,
                "steps_per_second": count * job.steps / min(plays),
                "reset_seconds": min(resets),
                "bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(state)) // count,
            }
        )
    return rows


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The figures as Markdown."""
    cells = [
        [
            row["task"],
            str(row["environments"]),
            f"{row['steps_per_second']:,.0f}",
            f"{row['reset_seconds']:.2f}",
            f"{row['bytes'] / 1000:.1f}",
        ]
        for row in rows
    ]
    return markdown(HEADS, cells)


def run(job: BenchMjx) -> None:
    """Measures, prints a table and writes the result file."""
    rows = [row for count in job.environments for row in measure(job, count)]
    result = provenance() | {"steps": job.steps, "rounds": job.rounds, "rows": rows}
    lines = table(rows)
    print("\n".join(lines))
    device = jax.devices()[0].device_kind.lower().replace(" ", "-")
    out = job.out or Path("experiments/results") / f"mjx-{device}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(result, indent=2) + "\n")
    out.with_suffix(".md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    run(tyro.cli(BenchMjx, prog="python -m experiments.bench_mjx"))
