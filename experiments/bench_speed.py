"""Updates a second against the machine's own rate for matrix products.

Run by `make bench-speed`. All loops are compiled and timed in turn, round after
round, so that a busy machine disturbs all alike. Rates are those of the best round
and hold for their machine only; ratios are medians of those within one round.
"""

import json
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro

from rewire_jax import sac
from rewire_jax.config import Settings
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Spec
from rewire_jax.plan import prepare
from rewire_jax.presets import preset
from rewire_jax.replay import Batch
from rewire_jax.runfolder import provenance
from rewire_jax.scenarios import make_scenario

SCENARIO = "halfcheetah/forgetting"
SQUARE = [(256, 256, 256)]
Products = list[tuple[int, int, int]]
"""Matrix products: rows, inner size and columns of each."""
Loop = Callable[[int], Any]
"""Does something so many times, and returns what to wait for."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """How to measure.

    Attributes:
      out: result file; named after the device if not given.
      rounds: how often each loop is timed.
      seconds: about how long each time.
      quick: tiny networks and short loops, to see that it runs.
    """

    out: Path | None = None
    rounds: int = 12
    seconds: float = 0.5
    quick: bool = False


def products(spec: Spec, batch: int) -> tuple[Products, Products]:
    """The matrix products that a plain update needs, for critics and for policy.

    With P and C the sums of inputs × outputs over the layers of policy and critic,
    and o, a, n the sizes of observation, action and hidden layers, they take

      critics: batch × (P + 2 (C + 3 C − (o + a) n)) multiply-adds: the next action,
        the targets, and the critics forward, to their weights and to their layers;
      policy: batch × (3 P − o n + 2 (2 C − o n)): the policy in the same three
        ways, and the critics forward and back to the action.
    """
    o, a, n = spec.observations, spec.actions, spec.hidden
    policy = list(pairwise([o, *[n] * spec.depth, 2 * a]))
    critic = list(pairwise([o + a, *[n] * spec.depth, 1]))

    def forward(layers):
        return [(batch, inputs, outputs) for inputs, outputs in layers]

    def trained(layers):
        to_weights = [(inputs, batch, outputs) for inputs, outputs in layers]
        return forward(layers) + to_weights + backward(layers[1:])

    def backward(layers):
        return [(batch, outputs, inputs) for inputs, outputs in layers]

    judged = forward(critic) + backward([(a, n), *critic[1:]])
    return (
        forward(policy) + 2 * (forward(critic) + trained(critic)),
        trained(policy) + 2 * judged,
    )


def multiply_adds(some: Products) -> int:
    """Multiplications, each with an addition, in all the products together."""
    return sum(rows * inner * columns for rows, inner, columns in some)


def product_loop(some: Products) -> Loop:
    """Computes all the products, again and again."""

    def operand(number, rows, columns):
        bound = rows**-0.5
        key = jax.random.key(number)
        return jax.random.uniform(key, (rows, columns), minval=-bound, maxval=bound)

    left = [operand(2 * k, rows, inner) for k, (rows, inner, _) in enumerate(some)]
    right = [operand(2 * k + 1, *shape) for k, (_, *shape) in enumerate(some)]

    def once(_, carry):
        # Each product needs the one before, so that none can be moved or left out.
        left = [x.at[0, 0].set(y[0, 0]) for x, y in zip(*carry, strict=True)]
        return left, [x @ y for x, y in zip(left, right, strict=True)]

    start = (left, [x @ y for x, y in zip(left, right, strict=True)])
    return jax.jit(lambda count: jax.lax.fori_loop(0, count, once, start)[1])


def updates(settings: Settings) -> tuple[Any, Callable[..., Any], Batch]:
    """A population of one in its second task, and its updates as training makes them.

    Returns:
      The population's state, a function `(state, batches, count) -> state` to be
      compiled, and batches `[32, batch, ...]` as the replay buffer gives them.
    """
    plan = prepare(settings)
    spec, make = plan.spec, find_method(settings.method).make
    o, shape = spec.observations, (32, settings.sac.batch_size)
    numbers = jax.random.normal(jax.random.key(1), (*shape, 2 * o + 1))
    action, ended = jnp.tanh(numbers[..., : spec.actions]), jnp.zeros(shape, bool)
    first, reward, second = numbers[..., :o], numbers[..., -1], numbers[..., o:-1]
    batches = Batch(first, action, reward, ended, ended, second)

    def begin(member):
        method = make(spec, member.options)
        learner = sac.init(member.keys, method, spec, member.sac)
        kept = method.end_task(learner.params, learner.memory, 0, None)
        params, memory = method.start_task(member.keys, *kept, 1)
        learner = learner._replace(params=params, memory=memory)
        return member, sac.restart(learner, member.sac)

    def advance(state, batches, count):
        member, learner = state
        method = make(spec, member.options)

        def one(number, carry):
            batch = jax.tree.map(lambda x: x[number % len(x)], batches)
            key = jax.random.fold_in(member.keys, number)
            learner, metrics = carry
            return sac.update(learner, metrics, batch, key, number, method, member.sac)

        first = jax.tree.map(lambda x: x[0], batches)
        metrics = sac.policy_metrics(learner, first, method, member.sac)
        metrics |= {"critic_loss": jnp.zeros(()), "q": jnp.zeros(())}
        return member, jax.lax.fori_loop(0, count, one, (learner, metrics))[0]

    state = jax.jit(jax.vmap(begin))(plan.members)
    return state, jax.vmap(advance, (0, None, None)), batches


def update_loop(settings: Settings) -> Loop:
    """Makes updates in one compiled loop, each time going on from the last."""
    state, advance, batches = updates(settings)
    compiled = jax.jit(advance, donate_argnums=0)

    def loop(count):
        nonlocal state
        state = compiled(state, batches, count)
        return state[1].log_temperature

    return loop


def timed(loop: Loop, count: int) -> float:
    """Seconds that the loop takes."""
    start = time.perf_counter()
    jax.block_until_ready(loop(count))
    return time.perf_counter() - start


def in_turn(loops: dict[str, Loop], rounds: int, seconds: float) -> dict[str, Any]:
    """Times all loops in turn; `best` and `median` are repetitions a second."""
    counts = {}
    for name, loop in loops.items():
        timed(loop, 2)  # compiles
        counts[name] = max(4, round(4 * seconds / timed(loop, 4)))
    taken = [{k: timed(f, counts[k]) for k, f in loops.items()} for _ in range(rounds)]
    figures = {}
    for name, count in counts.items():
        times = [one[name] for one in taken]
        figures[name] = {
            "count": count,
            "seconds": times,
            "best": count / min(times),
            "median": count / statistics.median(times),
        }
    return figures


def run(bench: Bench) -> dict[str, Any]:
    """Measures, prints a table and writes the result file."""
    scenario = make_scenario(SCENARIO)
    methods = {"plain": preset(scenario, "ft1"), "rewire": preset(scenario, "rewire")}
    rounds, seconds = bench.rounds, bench.seconds
    if bench.quick:
        rounds, seconds = 2, 0.02
        for name, settings in methods.items():
            small = replace(settings.sac, hidden=16, depth=1, batch_size=16)
            methods[name] = replace(settings, sac=small)
    common = methods["rewire"].sac
    delays = {common.policy_delay: common}
    if not bench.quick:
        delays[1] = replace(common, policy_delay=1, target_delay=1)
    spec = prepare(methods["rewire"]).spec
    critics, policy = products(spec, common.batch_size)
    loops, needed = {}, {}
    for name, some in (("square", SQUARE), ("shapes", critics + policy)):
        loops[name], needed[name] = product_loop(some), float(multiply_adds(some))
    for delay, chosen in delays.items():
        for name, settings in methods.items():
            loops[f"{name}/{delay}"] = update_loop(replace(settings, sac=chosen))
        whole = multiply_adds(critics) + multiply_adds(policy) / delay
        needed[f"plain/{delay}"] = whole
    load = [os.getloadavg()]
    figures = in_turn(loops, rounds, seconds)
    load.append(os.getloadavg())

    def times_faster(name, other):
        """How often the one repeats while the other does once, in the same round."""
        here, there = figures[name], figures[other]
        pairs = zip(here["seconds"], there["seconds"], strict=True)
        ratio = statistics.median(theirs / ours for ours, theirs in pairs)
        return ratio * here["count"] / there["count"]

    for name, count in needed.items():
        share = times_faster(name, "square") * count / needed["square"]
        figures[name] |= {"multiply_adds": count, "share": share}
    for delay in delays:
        cost = times_faster(f"plain/{delay}", f"rewire/{delay}")
        figures[f"rewire/{delay}"]["cost"] = cost
    result = provenance() | {
        "load": load,
        "sizes": spec._asdict() | {"batch": common.batch_size},
        "options": vars(methods["rewire"].options),
        "loops": figures,
    }
    shown = table(result)
    print(shown)
    device = jax.devices()[0].device_kind.lower().replace(" ", "-")
    out = bench.out or Path("experiments/results") / f"speed-{device}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(result, indent=2) + "\n")
    out.with_suffix(".md").write_text(f"```text\n{shown}\n```\n")
    print(out)
    return result


def table(result: dict[str, Any]) -> str:
    """The figures as text."""
    heads = ("best", "median", "share", "cost")
    lines = ["loop".ljust(9) + "".join(head.rjust(10) for head in heads)]
    for name, figures in result["loops"].items():
        cells = [f"{figures[h]:10.4g}" if h in figures else " " * 10 for h in heads]
        lines.append((name.ljust(9) + "".join(cells)).rstrip())
    square = result["loops"]["square"]
    flops = 2e-9 * square["multiply_adds"] * square["best"]
    before, after = (load[0] for load in result["load"])
    device = f"{result['device']}, load {before:.1f} to {after:.1f}"
    return "\n".join(
        [
            f"{device}; float32 products at {flops:.0f} GFLOP/s",
            *lines,
            "best, median: a second; plain/2: with the policy at every 2nd update",
            "share: of the rate of square products; cost: in plain updates",
        ]
    )


if __name__ == "__main__":
    run(tyro.cli(Bench, prog="python -m experiments.bench_speed"))
