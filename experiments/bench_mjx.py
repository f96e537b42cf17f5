"""Steps per second of Meta-World on MJX-Warp, by number of environments.

Run by `make bench-mjx`. Rates are those of the best round; actions are random.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from experiments import suite
from experiments.speed.timing import timed
from rewire_jax.envs.base import Environment, TaskChange
from rewire_jax.envs.metaworld import make_domain

COLUMNS = {
    "task": suite.show("task"),
    "environments": suite.show("environments"),
    "steps/s": suite.show("steps_per_second", ",.0f"),
    "reset s": suite.show("reset_seconds", ".2f"),
    "kB/environment": suite.show("bytes", ".1f", 1e-3),
}


@dataclass(frozen=True, kw_only=True)
class BenchMjx:
    """What to measure.

    Attributes:
      tasks: names of the tasks, together in one domain.
      environments: numbers of parallel environments.
      steps: steps of each environment, in one compiled loop.
      rounds: how often each loop is timed.
      out: the result files, without a suffix; named after the device if not given.
    """

    tasks: tuple[str, ...] = ("window-close", "push")
    environments: tuple[int, ...] = (1, 64, 1024)
    steps: int = 100
    rounds: int = 3
    out: Path | None = None


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
        state = reset(task, keys)
        resets = [timed(reset, task, keys) for _ in range(job.rounds)]
        timed(play, task, state, keys[0])  # compiles
        plays = [timed(play, task, state, keys[0]) for _ in range(job.rounds)]
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


def run(job: BenchMjx) -> None:
    """Measures, and writes the result."""
    rows = [row for count in job.environments for row in measure(job, count)]
    device = jax.devices()[0].device_kind.lower().replace(" ", "-")
    out = job.out or suite.RESULTS / f"mjx-{device}"
    title = f"Meta-World on MJX-Warp, best of {job.rounds} rounds of {job.steps} steps"
    suite.write(out, title, suite.table(rows, COLUMNS), (), rows)


if __name__ == "__main__":
    suite.command(BenchMjx, run, "bench_mjx")
