"""Whole loops, environments and updates, and updates alone; peers beside ours.

Peers learn on our environments with our sizes. Those that are not installed are named
all the same.
"""

import importlib
import importlib.metadata
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes

from experiments.speed.part import Effort, Part
from experiments.speed.timing import Loop, Timing, in_turn
from experiments.speed.updates import METHODS, draw_batches, update_loop
from experiments.suite import Row, show
from rewire_jax.core.settings import Settings
from rewire_jax.core.transition import Batch
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.reports import plots
from rewire_jax.training.run_setup import prepare

OURS = "rewire_jax"


class Case(NamedTuple):
    """Something that is timed.

    Attributes:
      name: whose.
      policy: "plain" or "rewire".
      delay: updates for each update of the policy.
    """

    name: str
    policy: str
    delay: int


class Peer(NamedTuple):
    """Another implementation.

    Attributes:
      module: file beside this one, with `update_loop` and `whole_loop`.
      package: what must be installed.
      cases: policies and delays that it has.
    """

    module: str
    package: str
    cases: tuple[tuple[str, int], ...]


PEERS = {
    "SBX": Peer("peer_sbx", "sbx-rl", (("plain", 2), ("plain", 1))),
    "rejax": Peer("peer_rejax", "rejax", (("plain", 1),)),
    "PyTorch": Peer("peer_torch", "torch", (("plain", 2), ("rewire", 2))),
}


def version(package: str) -> str | None:
    """That of a package, None where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def whole_loop(settings: Settings) -> Loop:
    """Steps of all our environments with all their updates, in a second task."""
    plan = prepare(settings)
    program, members = plan.program, plan.stacked
    first, second = (jax.tree.map(lambda x, i=i: x[i], plan.tasks) for i in range(2))
    active = np.ones(plan.num_slots, bool)
    state = program.begin(members, program.init(members), active, 0, first)
    learner = program.finish(members, state.learner, 0, None)
    state = program.begin(members, learner, active, 1, second)
    done = 0

    def loop(count):
        nonlocal state, done
        state, report = program.chunk(members, state, 1, second, done, count)
        done += count
        return report

    jax.block_until_ready(loop(settings.warmup // settings.envs + 1))
    return loop


def settings_of(effort: Effort, case: Case) -> Settings:
    """Everybody's sizes; few interactions come before the first updates."""
    delays = {"policy_delay": case.delay, "target_delay": case.delay}
    settings = effort.settings(METHODS[case.policy], **delays)
    return replace(settings, warmup=10 * settings.envs)


def make(effort: Effort, case: Case, batches: Batch) -> tuple[Loop, Loop]:
    """The whole loop of a case, and its updates from all the batches."""
    print(f"  preparing {' '.join(map(str, case))}", flush=True)
    settings = settings_of(effort, case)
    if case.name == OURS:
        update, size = update_loop(settings), len(batches.reward)
        return whole_loop(settings), lambda count: update(count * size)
    scenario = make_scenario(effort.scenario)
    environment, task = scenario.environment, scenario.tasks[1].data
    # Not before it is asked for: not everybody has it.
    peer = importlib.import_module(f"experiments.speed.{PEERS[case.name].module}")
    return (
        peer.whole_loop(settings, environment, task),
        peer.update_loop(settings, environment, task, batches),
    )


def measure(effort: Effort) -> list[Row]:
    """A row for each implementation, policy and delay."""
    cases = [Case(OURS, policy, delay) for delay in (2, 1) for policy in METHODS]
    if effort.quick:
        cases = [Case(OURS, "rewire", 2)]
    missing = []
    for name, peer in PEERS.items():
        own = [Case(name, *what) for what in peer.cases]
        if version(peer.package) is None or effort.quick:
            missing += own
        else:
            cases += own
    settings = settings_of(effort, cases[0])
    batches = draw_batches(prepare(settings).spec, settings.sac.batch_size)
    loops = {case: make(effort, case, batches) for case in cases}
    rounds, seconds = min(effort.rounds, 5), effort.seconds
    whole = in_turn({case: loops[case][0] for case in cases}, rounds, 4 * seconds)
    alone = in_turn({case: loops[case][1] for case in cases}, rounds, seconds)
    rows = []
    for case in cases:
        package = PEERS[case.name].package if case.name in PEERS else OURS
        rows.append(
            {
                **case._asdict(),
                "version": version(package),
                "interactions_per_second": settings.envs * whole[case].best,
                "updates_per_second": len(batches.reward) * alone[case].best,
                "whole": whole[case].figures(),
                "alone": alone[case].figures(),
                "whole_ratios": ratios(whole, case),
                "alone_ratios": ratios(alone, case),
            }
        )
    return rows + [case._asdict() for case in missing]


def ratios(timings: dict[Case, Timing], case: Case) -> Row:
    """How often ours repeats while a case does once, with the same delay."""
    return {
        policy: timings[ours].over(timings[case])
        for policy in METHODS
        if (ours := Case(OURS, policy, case.delay)) in timings
    }


def draw(axes: Axes, rows: list[Row]) -> None:
    """Interactions a second."""
    rows = [row for row in rows if "whole" in row]
    names = [f"{row['name']}, {row['policy']}, {row['delay']}" for row in rows]
    rates = [row["interactions_per_second"] for row in rows]
    colours = [plots.look(int(row["name"] != OURS))["color"] for row in rows]
    axes.barh(names, rates, color=colours)
    axes.invert_yaxis()
    axes.set_xlabel("interactions a second, with all their updates")


def _ratio(what: str, policy: str) -> Callable[[Row], str]:
    def text(row: Row) -> str:
        ratio = row.get(f"{what}_ratios", {}).get(policy)
        if ratio is None or row["name"] == OURS:
            return "–"
        return f"{ratio:.2f}" if ratio >= 1 else f"**{ratio:.2f}**"

    return text


PART = Part(
    title="Whole loops, and peers",
    reading="HalfCheetah on brax.v1, 128 environments, 64 updates after each of their "
    "steps, networks of 3 × 256, batches of 256. The updates a second are measured "
    "alone, without environments. The last four columns are our speed divided by that "
    "of the other implementation, with the same delay of the policy: medians of the "
    "ratios in each round. In bold, the other one is faster. SBX and PyTorch learn on "
    "the host and call the same compiled environments once for each step; rejax "
    "compiles the whole loop, and has no delayed policy updates. We wrote the PyTorch "
    "version for this comparison; its `rewire` uses straight-through SoftSort "
    "matrices. `make setup-bench` installs the "
    "peers.",
    measure=measure,
    columns={
        "implementation": show("name"),
        "version": lambda row: row.get("version") or "not installed",
        "policy": show("policy"),
        "critic updates for each policy update": show("delay"),
        "interactions a second": show("interactions_per_second", ",.0f"),
        "updates a second": show("updates_per_second", ",.0f"),
        "our plain loop": _ratio("whole", "plain"),
        "our rewire loop": _ratio("whole", "rewire"),
        "our plain updates": _ratio("alone", "plain"),
        "our rewire updates": _ratio("alone", "rewire"),
    },
    picture=(
        "Whole loops: implementation, policy, critic updates for each policy update",
        draw,
    ),
)
