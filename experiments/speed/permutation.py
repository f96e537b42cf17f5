"""The permutation, forward and backward, over its dense straight-through form."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from matplotlib.axes import Axes

from experiments.speed.part import Effort, Part
from experiments.speed.timing import Loop, in_turn
from experiments.suite import Row, show
from rewire_jax.nn.permutation import permute
from rewire_jax.nn.softsort_vjp import score_gradient
from rewire_jax.reports import plots

BATCH = 256
TAU = 1.0
WIDTHS = (128, 256, 512, 1024, 2048, 4096)
BLOCKS = (32, 64, 128, 256, 512, 1024)
Permute = Callable[[jax.Array, jax.Array, float], jax.Array]


def dense(x: jax.Array, scores: jax.Array, tau: float) -> jax.Array:
    """`permute` by n × n matrices: the hard one forward, SoftSort's backward."""
    order = jnp.argsort(scores)
    hard = jax.nn.one_hot(order, len(scores), dtype=x.dtype)
    soft = jax.nn.softmax(-jnp.abs(scores[order][:, None] - scores) / tau, axis=-1)
    return x @ (hard + soft - jax.lax.stop_gradient(soft)).T


def steps(function: Permute) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """`(count, x, scores) -> x, scores` after so many steps along the gradients."""

    def once(_, carry):
        x, scores = carry
        # Squares, so that the gradient of the result depends on the result.
        gradients = jax.grad(lambda x, v: jnp.sum(function(x, v, TAU) ** 2), (0, 1))
        by_x, by_scores = gradients(x, scores)
        return x - 1e-6 * by_x, scores - 1e-9 * by_scores

    return lambda count, *start: jax.lax.fori_loop(0, count, once, start)


def start(width: int) -> tuple[jax.Array, jax.Array]:
    """A layer's output `[batch, n]` and scores `[n]`."""
    key = jax.random.key(width)
    return jax.random.normal(key, (BATCH, width)), jax.random.uniform(key, (width,))


def measure(effort: Effort) -> list[Row]:
    """A row for each width."""
    rows = []
    for width in (8, 16) if effort.quick else WIDTHS:
        x, scores = start(width)
        loops: dict[str, Loop] = {}
        row: Row = {"hidden": width, "batch": BATCH}
        for name, function in (("permute", permute), ("dense", dense)):
            compiled = jax.jit(steps(function)).lower(2, x, scores).compile()

            def loop(count, compiled=compiled, x=x, scores=scores):
                return compiled(count, x, scores)

            loops[name] = loop
            memory = compiled.memory_analysis()
            assert memory is not None
            row[f"{name}_bytes"] = memory.temp_size_in_bytes
        timings = in_turn(loops, effort.rounds, effort.seconds / 2)
        for name, timing in timings.items():
            row[f"{name}_ms"] = 1e3 / timing.best
            row[f"{name}_seconds"] = timing.seconds
        row["faster"] = timings["permute"].over(timings["dense"])
        rows.append(row)
    return rows


def block_times(effort: Effort) -> list[Row]:
    """Milliseconds of the gradient in the scores, by the places in its blocks."""
    rows = []
    for width in (16,) if effort.quick else (256, 1024):
        for members in (1, 2) if effort.quick else (1, 32):
            keys = jax.random.split(jax.random.key(0), 3)
            shape = members, BATCH, width
            gradients, values = (jax.random.normal(key, shape) for key in keys[:2])
            scores = jnp.sort(jax.random.uniform(keys[2], (members, width)))
            start = gradients, values, scores
            blocks = (4, 16) if effort.quick else [n for n in BLOCKS if n <= width]
            loops: dict[int, Loop] = {
                block: functools.partial(block_loop(block), start) for block in blocks
            }
            timings = in_turn(loops, effort.rounds, effort.seconds / 2)
            for block, timing in timings.items():
                row: Row = {"hidden": width, "members": members, "block": block}
                rows.append(row | {"ms": 1e3 / timing.best} | timing.figures())
    return rows


def block_loop(block: int) -> Callable[..., jax.Array]:
    """`(arrays, count) -> scores [members, n]`, so many steps along the gradient."""

    def steps(arrays, count):
        gradient, values, scores = arrays

        def once(_, scores):
            tau = jnp.asarray(TAU)
            made = score_gradient([gradient], [values], scores, tau, block, axis=1)
            return scores - 1e-9 * made

        return jax.lax.fori_loop(0, count, once, scores)

    return jax.jit(jax.vmap(steps, (0, None)))


def draw(axes: Axes, rows: list[Row]) -> None:
    """Time by width."""
    widths = [row["hidden"] for row in rows]
    for i, (name, label) in enumerate(
        (("permute", "permute"), ("dense", "dense form"))
    ):
        times = [row[f"{name}_ms"] for row in rows]
        axes.plot(widths, times, marker="o", label=label, **plots.look(i))
    plots.doubling(axes, widths)
    axes.set_yscale("log")
    axes.set_xlabel("neurons")
    axes.set_ylabel("ms, forward and backward")
    axes.legend(frameon=False)


def _megabytes(name: str) -> Callable[[Row], str]:
    return lambda row: f"{row[f'{name}_bytes'] / 1e6:,.1f}"


PART = Part(
    title="The permutation, forward and backward",
    reading="`permute` is compared with the straight-through form that uses n × n "
    "matrices. XLA compiles both. A measurement computes the value and the gradients "
    "of a layer's output and of the scores. Memory is that of temporary arrays, as "
    "compiled.",
    measure=measure,
    columns={
        "n": show("hidden"),
        "batch": show("batch"),
        "`permute`, ms": show("permute_ms", ",.3g"),
        "dense, ms": show("dense_ms", ",.3g"),
        "times faster": show("faster", ".2f"),
        "`permute`, MB": _megabytes("permute"),
        "dense, MB": _megabytes("dense"),
    },
    picture=(f"Permutation of n neurons, batch {BATCH}", draw),
)
