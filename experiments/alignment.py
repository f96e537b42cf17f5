"""Do the adapters converge? Compares forms of the alignment loss and learning rates.

Hidden layers start from the weights of the previous task. Adam trains them only with
the alignment loss (Eq. 11); random values replace the gradient of the new task. The
goal is that the order of the adapters no longer changes, and that the weights are the
previous weights in this order. Then refined wirings (Eq. 12) restore the old policies.
With "matching" the adapters are not trained but solved for.
"""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments import suite
from rewire_jax.methods import matching, rewire_losses, wiring
from rewire_jax.nn import networks
from rewire_jax.reports import plots

# Form of the loss, factor on the adapters' learning rate.
VARIANTS = (
    ("norm", 1),
    ("expanded", 1),
    ("expanded", 10),
    ("expanded", 0.01),
    ("matching", 0),
)
# Measures of a row, with their formats.
MEASURES = {
    "distance": ("weights", ".2f"),
    "moving": ("orders", ".0%"),
    "actions": ("actions", ".2f"),
}

NOTES = (
    "The columns are numbers of updates. Weights: squared distance between the new "
    "weights and the previous weights in the adapters' order, divided by the squared "
    "norm of the previous weights. Orders: share of positions in the adapters' orders "
    "that changed in the last 100 updates. Actions: an old policy acts with its "
    "refined wiring and the new weights; the squared change of its outputs, divided "
    "by their variance over observations.",
)


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """What to compute.

    Attributes:
      observations: inputs of the first layer.
      width: neurons in each of three hidden layers.
      updates: numbers of policy updates after which results are recorded.
      rate: Adam's learning rate.
      beta: weight of the alignment loss.
      tau: temperature of the adapters' relaxation.
      noise: standard deviation of the new task's gradient.
      match_every: updates between two solutions, with "matching".
      seeds: number of seeds.
      out: the result files, without a suffix.
    """

    observations: int = 17
    width: int = 128
    updates: tuple[int, ...] = (100, 300, 1_000, 3_000, 10_000)
    rate: float = 1e-3
    beta: float = 100.0
    tau: float = 0.1
    noise: float = 0.01
    match_every: int = 100
    seeds: int = 3
    out: Path = suite.RESULTS / "alignment"


def learn(job: Alignment, form: str, adapter_rate: float, seed: jax.Array):
    """One seed.

    Returns:
      `[looks]` of each of `MEASURES`.
    """
    key = jax.random.key(seed)
    width, depth = job.width, 3
    previous = networks.init_mlp(key, [job.observations, *[width] * depth])
    adapters = wiring.identity_adapters(depth, width)
    adam = optax.scale_by_adam()
    square = rewire_losses.weight_loss(
        previous, jax.tree.map(jnp.zeros_like, list(previous))
    )

    probe = policy_probe(job, key, previous)

    def loss(params, expanded=form == "expanded"):
        hidden, adapters = params
        if form == "matching":
            adapters = jax.lax.stop_gradient(adapters)
        distance = rewire_losses.alignment_loss(
            hidden, previous, adapters, job.tau, expanded=expanded
        )
        return job.beta * distance

    def update(index, carry):
        params, state = carry
        hidden, adapters = jax.grad(loss)(params)
        leaves, structure = jax.tree.flatten(hidden)
        keys = jax.random.split(jax.random.fold_in(key, index), len(leaves))
        noisy = [
            leaf + job.noise * jax.random.normal(k, leaf.shape)
            for leaf, k in zip(leaves, keys, strict=True)
        ]
        gradient = jax.tree.unflatten(structure, noisy), adapters
        (hidden, adapters), state = adam.update(gradient, state)
        adapters = jax.tree.map(lambda x: adapter_rate * x, adapters)
        step = jax.tree.map(lambda x: -job.rate * x, (hidden, adapters))
        params = optax.apply_updates(params, step)
        if form == "matching":
            due = (index + 1) % job.match_every == 0
            params = jax.lax.cond(due, match, lambda params: params, params)
        return params, state

    def match(params):
        return params[0], matching.match(params[0], previous, params[1])

    def orders(params):
        return jnp.argsort(jnp.concatenate(params[1]), axis=-1)

    def look(carry, bounds):
        begin, end = bounds
        before, state = jax.lax.fori_loop(begin, end - 100, update, carry)
        carry = jax.lax.fori_loop(end - 100, end, update, (before, state))
        params, state = carry
        moving = jnp.mean(orders(before) != orders(params))
        if form == "matching":  # as at the end of a task
            params = match(params)
        distance = loss(params, expanded=False) / job.beta / square
        return (params, state), (distance, moving, probe(*params))

    params = previous, adapters
    ends = jnp.asarray(job.updates)
    bounds = jnp.concatenate([jnp.zeros(1, int), ends[:-1]]), ends
    return jax.lax.scan(look, (params, adam.init(params)), bounds)[1]


def policy_probe(job: Alignment, key: jax.Array, previous: Any):
    """Returns `(hidden, adapters) -> []`, the change of an old policy's outputs."""
    head_key, order_key, observation_key = jax.random.split(key, 3)
    head = networks.init_linear(head_key, job.width, 12)
    orders = jax.vmap(lambda k: jax.random.permutation(k, job.width))(
        jax.random.split(order_key, len(previous))
    )
    observations = jax.random.normal(observation_key, (512, job.observations))

    def outputs(hidden, orders):
        return networks.mlp([*wiring.fold(hidden, orders), head], observations)

    before = outputs(previous, orders)

    def change(hidden, adapters):
        now = outputs(hidden, wiring.refine(orders, adapters))
        return jnp.mean((now - before) ** 2) / jnp.mean(jnp.var(before, axis=0))

    return change


def means(rows: Sequence[Mapping[str, Any]], measure: str) -> dict[Any, list[float]]:
    """Means over seeds, one for each number of updates, by form and rate."""
    found: dict[Any, list[float]] = {}
    for place, own in suite.grouped(rows, "form", "rate", "updates").items():
        mean = statistics.mean(row[measure] for row in own)
        found.setdefault(place[:2], []).append(mean)
    return found


def table(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Means over seeds, a line for each form, rate and measure."""
    looks = sorted({row["updates"] for row in rows})
    lines = [["form", "adapter rate", "", *(f"{updates:,}" for updates in looks)]]
    of = {measure: means(rows, measure) for measure in MEASURES}
    for form, rate in VARIANTS:
        for measure, (name, shown) in MEASURES.items():
            cells = [format(mean, shown) for mean in of[measure][form, rate]]
            lines.append([form, f"{rate}" if rate else "–", name, *cells])
    return lines


def draw(rows: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Writes the picture: each measure against updates."""
    figure, panels = plots.empty((11.0, 3.8), 1, len(MEASURES))
    looks = sorted({row["updates"] for row in rows})
    for axes, (measure, (name, _)) in zip(panels, MEASURES.items(), strict=True):
        for i, ((form, rate), values) in enumerate(means(rows, measure).items()):
            label = f"{form}, adapter rate {rate}" if rate else form
            axes.plot(looks, values, marker=".", **plots.look(i), label=label)
        axes.set_xscale("log")
        axes.set_xlabel("updates")
        axes.set_title(name, fontsize=11)
        axes.grid(axis="y", color="0.9")
    lines, labels = panels[0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside right center", frameon=False)
    plots.entitle(figure, title, "0: the old policies are as before")
    figure.savefig(path)


def run(job: Alignment) -> None:
    """Computes all variants and writes the result."""
    rows = []
    for form, rate in VARIANTS:
        one = partial(learn, job, form, rate)
        found = np.array(jax.jit(jax.vmap(one))(jnp.arange(job.seeds)), np.float64)
        for seed, look in np.ndindex(job.seeds, len(job.updates)):
            row = {"form": form, "rate": rate, "seed": seed}
            row["updates"] = job.updates[look]
            rows.append(row | dict(zip(MEASURES, found[:, seed, look], strict=True)))
    title = f"Alignment alone, width {job.width}, beta {job.beta:g}"
    title += f", mean of {job.seeds} seeds"
    picture = f"![Alignment alone]({job.out.name}.png)"
    suite.write(job.out, title, table(rows), [*NOTES, "", picture], rows)
    draw(rows, title, job.out.with_suffix(".png"))


if __name__ == "__main__":
    suite.command(Alignment, run, "alignment")
