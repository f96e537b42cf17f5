"""The time of the loop around Continual World's simulators, compared with its parts.

It times only the simulators, only the updates, and the loop of both, without and with
overlap. All take the same number of steps and are timed in turn. A ratio is the median
over rounds of the ratio within a round, so slow phases of the machine do not change it.
"""

import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import rewire_jax
from experiments import suite
from experiments.speed.timing import timed
from rewire_jax.core.arguments import require
from rewire_jax.envs.base import HostEnvironment
from rewire_jax.envs.vector_env import VectorEnv
from rewire_jax.training.run_setup import Plan, prepare

COLUMNS = {
    "method": suite.show("method"),
    "members": suite.show("members"),
    "width": suite.show("hidden"),
    "simulators": suite.show("simulators_ms", ".0f"),
    "updates": suite.show("updates_ms", ".0f"),
    "loop": suite.show("loop_ms", ".0f"),
    "÷ sum": suite.show("loop_over_sum", ".2f"),
    "with overlap": suite.show("overlapped_ms", ".0f"),
    "÷ larger": suite.show("overlapped_over_larger", ".2f"),
}


@dataclass(frozen=True, kw_only=True)
class HostLoop:
    """What to measure.

    Attributes:
      scenario: a scenario of the domain "metaworld"; only its first task is used.
      methods: names of the methods.
      seeds: number of members.
      widths: neurons in each layer; 0 for the paper's. With narrow layers, simulators
        and updates take similar times, and overlap gains more.
      times: how often 50 steps and 50 updates are made in a measurement; 40 is the
        number between two progress reports of the quick profile.
      rounds: number of measurements of each kind.
      out: result files, without a suffix.
    """

    scenario: str = "continual_world/t3"
    methods: tuple[str, ...] = ("ft1", "rewire")
    seeds: int = 1
    widths: tuple[int, ...] = (0, 32)
    times: int = 20
    rounds: int = 9
    out: Path = suite.RESULTS / "host-loop"


class Loop:
    """The loop of a task, in the middle of the task."""

    def __init__(self, plan: Plan):
        """Begins the first task and makes its first updates."""
        self.plan = plan
        self.task = jax.tree.map(lambda leaf: leaf[0], plan.tasks)
        learner = plan.program.init(plan.stacked)
        active = np.ones(plan.num_slots, bool)
        self.state = plan.program.begin(plan.stacked, learner, active, 0, self.task)
        self.time = 0
        settings = plan.settings
        self.steps(-(-settings.warmup // settings.update_every) + 1)
        self.updates(1)

    def steps(self, times: int) -> None:
        """Steps and updates."""
        steps = times * self.plan.settings.update_every
        self.state, _ = self.plan.program.chunk(
            self.plan.stacked, self.state, 0, self.task, self.time, steps
        )
        jax.block_until_ready(self.state)
        self.time += steps

    def updates(self, times: int) -> None:
        """Updates alone."""
        self.state = self.plan.program.offline_update(
            self.plan.stacked, self.state, 0, self.time, 0, times
        )
        jax.block_until_ready(self.state)


def simulate(lanes: VectorEnv, environment: HostEnvironment, steps: int) -> None:
    """Steps simulators with random actions, and resets them at their episodes' end."""
    draw = np.random.default_rng(0)
    count = len(lanes.seeds)
    for _ in range(steps):
        if lanes.task < 0 or lanes.steps[0] == environment.episode_length:
            lanes.reset(0, draw.integers(2**31, size=count))
        size = (count, environment.action_size)
        lanes.step(draw.uniform(-1, 1, size).astype(np.float32))


def measure(job: HostLoop, method: str, width: int) -> dict[str, Any]:
    """Milliseconds for 50 steps and 50 updates of all members, and ratios; medians."""
    scenario = rewire_jax.make_scenario(job.scenario)
    environment = scenario.environment
    if not isinstance(environment, HostEnvironment):
        raise rewire_jax.UserError(f"{job.scenario} is not stepped on the host")
    paper = rewire_jax.preset(scenario, method, "paper")
    sac = dataclasses.replace(paper.sac, hidden=width or paper.sac.hidden)
    settings = dataclasses.replace(paper, tasks=1, seeds=job.seeds, sac=sac)
    loops = [
        Loop(prepare(dataclasses.replace(settings, overlap=overlap), scenario))
        for overlap in (False, True)
    ]
    lanes = VectorEnv(environment, job.seeds * settings.envs)
    rounds = []
    for _ in range(job.rounds):
        steps = job.times * settings.update_every
        seconds = {
            "simulators": timed(simulate, lanes, environment, steps),
            "updates": timed(loops[0].updates, job.times),
        }
        parts = list(seconds.values())
        for name, loop in zip(("loop", "overlapped"), loops, strict=True):
            loop.steps(1)  # the simulators come to where this one is
            seconds[name] = timed(loop.steps, job.times)
        rounds.append(
            {f"{name}_ms": 1e3 * value / job.times for name, value in seconds.items()}
            | {
                "loop_over_sum": seconds["loop"] / sum(parts),
                "overlapped_over_larger": seconds["overlapped"] / max(parts),
            }
        )
    medians = {
        name: float(np.median([values[name] for values in rounds]))
        for name in rounds[0]
    }
    return {"method": method, "members": job.seeds, "hidden": sac.hidden, **medians}


def run(job: HostLoop) -> None:
    """Measures all methods and writes the result.

    Raises:
      UserError: wrong arguments.
    """
    require(job.rounds > 0, f"--rounds must be at least 1, not {job.rounds}")
    require(job.times > 0, f"--times must be at least 1, not {job.times}")
    cases = itertools.product(job.widths, job.methods)
    rows = [measure(job, method, width) for width, method in cases]
    title = f"{job.scenario}, paper profile: milliseconds for 50 steps and 50 updates"
    notes = [
        f"Medians of {job.rounds} rounds; simulators and updates were timed alone. "
        "With overlap, the next steps run during the updates, with the policy from "
        "before these updates. The ratios are medians of the ratios in each round: the "
        "loop over simulators and updates together, and the loop with overlap over the "
        "larger of the two."
    ]
    suite.write(job.out, title, suite.table(rows, COLUMNS), notes, rows)


if __name__ == "__main__":
    suite.command(HostLoop, run, "host_loop")
