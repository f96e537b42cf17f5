"""Populations of several sizes: compile time, memory, and time per member.

Each size is measured in a separate process, so that its peak memory includes no other
size. Interactions are timed together with their updates, and the best round counts.
"""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import rewire_jax
from experiments import suite
from rewire_jax.core.arguments import require
from rewire_jax.reports import plots
from rewire_jax.training import memory_estimate
from rewire_jax.training.run_setup import prepare

READING = (
    "A population is a set of members that one compiled function trains together. "
    "Times are of "
    "training, environments and updates, in the best round; processor time is that of "
    "all threads. Planned is what the compiler plans for a chunk of training (its "
    "arguments and temporary arrays); estimated is what "
    "`rewire_jax.training.memory_estimate` counts for "
    "the same before anything is compiled. On a device with its own memory, the peak "
    "is the device's. Otherwise it is the process's, with the memory for compiling. "
    "Compile time is "
    "that of a chunk, traced and without a cache of earlier compilations."
)

COLUMNS = {
    "members": suite.show("members"),
    "compile, s": suite.show("compile_seconds", ".0f"),
    "processor s": suite.show("compile_processor_seconds", ".0f"),
    "estimated, MB a member": suite.show("estimated", ".1f", 1e-6),
    "planned, MB a member": lambda row: (
        f"{(row['argument'] + row['temporary']) / 1e6:.1f}"
    ),
    "peak, MB": suite.show("peak", ",.0f", 1e-6),
    "ms a member and interaction": suite.show("seconds", ".3g", 1e3),
    "processor ms": suite.show("processor_seconds", ".3g", 1e3),
}


@dataclass(frozen=True, kw_only=True)
class Population:
    """What to measure.

    Attributes:
      members: sizes of the populations, the smallest first.
      scenario: name of the scenario.
      method: name of the method.
      profile: profile of the settings.
      rounds: how often each size is timed.
      steps: vector steps in a round.
      out: the result files, without a suffix; named after the device if not given.
      measure: measure only this size, in this process, and print the result as JSON.
    """

    members: tuple[int, ...] = (1, 8, 32)
    scenario: str = "halfcheetah/forgetting"
    method: str = "rewire"
    profile: str = "quick"
    rounds: int = 5
    steps: int = 10
    out: Path | None = None
    measure: bool = False


def measure(job: Population, members: int) -> dict[str, Any]:
    """Measures a population in this process; a row of the result."""
    scenario = rewire_jax.make_scenario(job.scenario)
    settings = rewire_jax.preset(scenario, job.method, job.profile)
    plan = prepare(replace(settings, seeds=members), scenario)
    program, stacked = plan.program, plan.stacked
    task = jax.tree.map(lambda leaf: leaf[0], plan.tasks)
    active = jnp.ones(members, bool)
    state = program.begin(stacked, program.init(stacked), active, 0, task)
    began, used = time.perf_counter(), time.process_time()
    lowered = program.chunk.lower(stacked, state, 0, task, 0, 1)  # type: ignore
    chunk = lowered.compile()
    compiling = time.perf_counter() - began, time.process_time() - used
    # Up to where updates begin.
    done = settings.warmup // settings.envs
    state, _ = chunk(stacked, state, 0, task, 0, done)
    rounds = []
    for _ in range(job.rounds):
        jax.block_until_ready(state)
        began, used = time.perf_counter(), time.process_time()
        state, _ = chunk(stacked, state, 0, task, done, job.steps)
        jax.block_until_ready(state)
        rounds.append((time.perf_counter() - began, time.process_time() - used))
        done += job.steps
    # The estimate's own traces are no part of the times.
    need = memory_estimate.need(plan)
    planned = chunk.memory_analysis()
    taken = members * job.steps * settings.envs
    wall, processor = (min(times) / taken for times in zip(*rounds, strict=True))
    return {
        "members": members,
        "side_by_side": memory_estimate.fitting(need, jax.local_devices()),
        "compile_seconds": compiling[0],
        "compile_processor_seconds": compiling[1],
        "seconds": wall,
        "processor_seconds": processor,
        "estimated": need.learner + need.buffer + need.environments + need.work,
        "argument": planned.argument_size_in_bytes / members,
        "temporary": planned.temp_size_in_bytes / members,
        "output": planned.output_size_in_bytes / members,
        "peak": peak(),
    }


def peak() -> int:
    """Bytes that the device has held at most, or this process on a CPU."""
    stats = jax.devices()[0].memory_stats() or {}
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # as Linux has it
    return stats.get("peak_bytes_in_use", 1024 * kilobytes)


def apart(job: Population, members: int) -> dict[str, Any]:
    """Measures a population in a process of its own.

    Raises:
      UserError: it failed; what it said has been shown.
    """
    command = [sys.executable, "-m", "experiments.population", "--measure"]
    for name in ("scenario", "method", "profile", "rounds", "steps"):
        command += [f"--{name}", str(getattr(job, name))]
    done = subprocess.run(
        [*command, "--members", str(members)],
        env=os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    require(done.returncode == 0, f"measuring {members} members failed")
    return json.loads(done.stdout.splitlines()[-1])


def headline(rows: Sequence[Mapping[str, Any]], key: str) -> list[str]:
    """Markdown: what the larger populations cost, in units of the smallest.

    Args:
      rows: the smallest first.
      key: by which time.
    """
    first, *others = rows
    lines = [
        f"- {row['members']} members cost "
        f"**{row['members'] * row[key] / (first['members'] * first[key]):.3g} times** "
        f"what {first['members']} costs: per member {row[key] / first[key]:.2f} times."
        for row in others
    ]
    most = first["side_by_side"]
    return [*lines, f"- A sweep trains at most {most} side by side on this device."]


def draw(rows: Sequence[Mapping[str, Any]], key: str, path: Path) -> None:
    """Writes the picture: time per member against members."""
    figure, (axes,) = plots.empty((7.0, 4.2), 1, 1)
    members = [row["members"] for row in rows]
    plots.by_size(axes, members, [1e3 * row[key] for row in rows])
    axes.set_xlabel("members side by side")
    axes.set_ylabel("ms a member and interaction")
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    clock = key.replace("_seconds", " time").replace("seconds", "wall clock")
    plots.entitle(figure, f"Time per member, {jax.devices()[0].device_kind}", clock)
    figure.savefig(path)


def run(job: Population) -> None:
    """Measures all sizes, and writes the result; or a single one.

    Raises:
      UserError: wrong arguments, or a measurement failed.
    """
    require(
        min(job.members, default=0) > 0 and min(job.rounds, job.steps) > 0,
        "--members, --rounds and --steps must be at least 1",
    )
    if job.measure:
        print(json.dumps(measure(job, job.members[0])))
        return
    before = os.getloadavg()[0]
    rows = [apart(job, members) for members in sorted(job.members)]
    after = os.getloadavg()[0]
    device = jax.devices()[0]
    # What else a machine does is in its clock, but not in this process's time.
    key = "processor_seconds" if device.platform == "cpu" else "seconds"
    name = device.device_kind.lower().replace(" ", "-")
    out = job.out or suite.RESULTS / f"population-{name}"
    cores = len(os.sched_getaffinity(0))
    notes = (
        *headline(rows, key),
        "",
        READING,
        "",
        f"{job.method} on {job.scenario}, {job.profile} profile; {cores} cores for "
        f"this, load average {before:.1f} before and {after:.1f} after; best of "
        f"{job.rounds} rounds of {job.steps} steps.",
    )
    suite.write(out, "Members side by side", suite.table(rows, COLUMNS), notes, rows)
    draw(rows, key, out.with_suffix(".png"))
    print(out.with_suffix(".png"))


if __name__ == "__main__":
    suite.command(Population, run, "population")
