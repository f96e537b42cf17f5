"""Updates a second against the machine's own rate for matrix products."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from experiments.speed.part import Effort, Part
from experiments.speed.products import SQUARE, multiply_adds, product_loop, products
from experiments.speed.timing import Loop, in_turn
from experiments.suite import Row, show
from rewire_jax.core.settings import Settings
from rewire_jax.core.transition import Batch
from rewire_jax.methods import find_method
from rewire_jax.methods.round import Round
from rewire_jax.methods.spec import Spec
from rewire_jax.training import sac, sac_updates
from rewire_jax.training.run_setup import prepare

METHODS = {"plain": "ft1", "rewire": "rewire"}
MEASURED = METHODS | {"tuned": "rewire_tuned"}


def draw_batches(spec: Spec, size: int) -> Batch:
    """Batches `[32, size]` as the replay buffer gives them, of random numbers."""
    o, shape = spec.observations, (32, size)
    numbers = jax.random.normal(jax.random.key(1), (*shape, 2 * o + 1))
    action, ended = jnp.tanh(numbers[..., : spec.actions]), jnp.zeros(shape, bool)
    first, reward, second = numbers[..., :o], numbers[..., -1], numbers[..., o:-1]
    return Batch(first, action, reward, ended, ended, second)


def updates(
    settings: Settings, group: int | None = None
) -> tuple[Any, Callable[..., Any], Batch]:
    """A population of one in its second task, and its updates as training makes them.

    Args:
      settings: of the run.
      group: updates in a group, 1 for a branch in each; by default as in training.

    Returns:
      The population's state, a function `(state, batches, count) -> state` to be
      compiled, and batches for it.
    """
    plan = prepare(settings)
    spec, make = plan.spec, find_method(settings.method).make

    def begin(member):
        method = make(spec, member.options)
        learner = sac.init(member.keys, method, spec, member.sac)
        kept = method.end_task(
            learner.params, learner.method_state, jnp.asarray(0), None
        )
        began = method.start_task(member.keys, *kept, jnp.asarray(1))
        learner = learner.with_learned(began)
        return member, sac.restart(learner, member.sac)

    def advance(state, batches, count):
        member, learner = state
        method = make(spec, member.options)
        drawn, *size = batches.action.shape

        def batch(number):
            return jax.tree.map(lambda x: x[number], batches)

        def draw(key):
            return sac.sample_update_noise(
                key, learner.method_state, (), size, method, member.sac
            )

        def several(number, learner):
            key, first = jax.random.fold_in(member.keys, number), number * drawn
            draws = jax.vmap(draw)(jax.random.split(key, drawn))
            made = jnp.minimum(drawn, count - first)
            # At most 2, and `repetitions` gives even counts.
            together = group or sac_updates.group_size(drawn, member.sac)
            numbers = draws, batch, first, made
            learner, metrics = sac_updates.updates(
                learner, *numbers, method, member.sac, together
            )
            latest = Round(first, first + drawn, metrics)
            return learner.with_learned(
                method.after_round(learner.params, learner.method_state, latest)
            )

        return member, jax.lax.fori_loop(0, -(-count // drawn), several, learner)

    state = jax.jit(jax.vmap(begin))(plan.stacked)
    batches = draw_batches(spec, settings.sac.batch_size)
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


def measure(effort: Effort) -> list[Row]:
    """A row for each loop."""
    settings = effort.settings("ft1")
    spec, batch = prepare(settings).spec, settings.sac.batch_size
    critics, policy = products(spec, batch)
    loops, needed = {}, {}
    for name, some in (("square", SQUARE), ("shapes", critics + policy)):
        loops[name], needed[name] = product_loop(some), float(multiply_adds(some))
    delays = (2,) if effort.quick else (2, 1)
    for delay in delays:
        sac = {"policy_delay": delay, "target_delay": delay}
        for name, method in MEASURED.items():
            loops[f"{name}/{delay}"] = update_loop(effort.settings(method, **sac))
        whole = multiply_adds(critics) + multiply_adds(policy) / delay
        needed[f"plain/{delay}"] = whole
    timings = in_turn(loops, effort.rounds, effort.seconds)
    rows = []
    for name, timing in timings.items():
        row = {"loop": name, "batch": batch, **spec._asdict(), **timing.figures()}
        if name in needed:
            share = timing.over(timings["square"]) * needed[name] / needed["square"]
            row |= {"multiply_adds": needed[name], "share": share}
        kind, _, every = name.partition("/")
        if every and kind != "plain":
            row["cost"] = timings[f"plain/{every}"].over(timing)
        rows.append(row)
    return rows


def _flops(row: Row) -> str:
    return (
        f"{2e-9 * row['multiply_adds'] * row['best']:,.0f}" if "share" in row else "–"
    )


PART = Part(
    title="Updates a second, against matrix products",
    reading="`square` is one product of 256 × 256 matrices. `shapes` are all matrix "
    "products of a plain update, alone. `/2`: every second update also updates the "
    "policy; `/1`: every update does. `tuned` is the method `rewire_tuned`. Share: "
    "GFLOP/s divided by that of `square`. Cost: the time of an update divided by that "
    "of a plain update, the median over rounds.",
    measure=measure,
    columns={
        "loop": lambda row: f"`{row['loop']}`",
        "a second, best": show("best", ",.3g"),
        "median": show("median", ",.3g"),
        "GFLOP/s": _flops,
        "share": show("share", ".0%"),
        "cost": show("cost", ".2f"),
    },
)
