"""Does the alignment loss settle? Its form and the adapters' learning rate compared.

Hidden layers start where the last task left them and are pulled to it by the alignment
loss (Eq. 11) alone, under Adam, with random numbers for the new task's gradient. What
is hoped for: adapters whose order stays, and weights that are the previous ones in
that order, so that refined wirings (Eq. 12) give the old policies back.
"""

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from rewire_jax import keep_compiled
from rewire_jax.methods import rewire_losses, wiring
from rewire_jax.nn import networks
from rewire_jax.storage.run_folder import provenance

# Form of the loss, factor on the adapters' learning rate.
VARIANTS = (("norm", 1), ("expanded", 1), ("expanded", 10), ("expanded", 0.01))


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """What to compute.

    Attributes:
      observations: inputs of the first layer.
      width: neurons in each of three hidden layers.
      updates: policy updates after which to look.
      rate: Adam's learning rate.
      beta: weight of the alignment loss.
      tau: temperature of the adapters' relaxation.
      noise: standard deviation of the new task's gradient.
      seeds: how many.
      out: result file; a Markdown table is written beside it.
    """

    observations: int = 17
    width: int = 128
    updates: tuple[int, ...] = (100, 1_000, 5_000, 10_000, 20_000)
    rate: float = 1e-3
    beta: float = 100.0
    tau: float = 0.1
    noise: float = 0.01
    seeds: int = 3
    out: Path = Path("experiments/results/alignment.json")


def learn(job: Alignment, form: str, adapter_rate: float, seed: jax.Array):
    """One seed.

    Returns:
      `[looks]` squared distance of the weights to the adapted previous ones, relative
      to the latter's square; and the share of adapters' places that changed in the
      100 updates before.
    """
    key = jax.random.key(seed)
    width, depth = job.width, 3
    previous = networks.init_mlp(key, [job.observations, *[width] * depth])
    adapters = wiring.identity_adapters(depth, width)
    adam = optax.scale_by_adam()
    square = rewire_losses.weight_loss(
        previous, jax.tree.map(jnp.zeros_like, list(previous))
    )

    def loss(params, expanded=form == "expanded"):
        hidden, adapters = params
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
        return optax.apply_updates(params, step), state

    def orders(params):
        return jnp.argsort(jnp.concatenate(params[1]), axis=-1)

    def look(carry, bounds):
        begin, end = bounds
        before, state = jax.lax.fori_loop(begin, end - 100, update, carry)
        carry = jax.lax.fori_loop(end - 100, end, update, (before, state))
        distance = loss(carry[0], expanded=False) / job.beta / square
        return carry, (distance, jnp.mean(orders(before) != orders(carry[0])))

    params = previous, adapters
    ends = jnp.asarray(job.updates)
    bounds = jnp.concatenate([jnp.zeros(1, int), ends[:-1]]), ends
    return jax.lax.scan(look, (params, adam.init(params)), bounds)[1]


def run(job: Alignment) -> None:
    """Computes all variants and writes the result."""
    rows = []
    for form, rate in VARIANTS:
        one = partial(learn, job, form, rate)
        distances, moves = jax.jit(jax.vmap(one))(jnp.arange(job.seeds))
        rows.append(
            {
                "form": form,
                "adapter_rate": rate,
                "distance": np.asarray(distances, np.float64).tolist(),
                "moving": np.asarray(moves, np.float64).tolist(),
            }
        )
    facts = provenance()
    options = {k: v for k, v in vars(job).items() if k != "out"}
    result = {"settings": options, "rows": rows, "provenance": facts}
    job.out.parent.mkdir(parents=True, exist_ok=True)
    job.out.write_text(json.dumps(result, indent=1) + "\n")
    heads = " | ".join(f"{updates:,}" for updates in job.updates)
    table = [
        f"# Alignment alone, width {job.width}, beta {job.beta:g}, mean of "
        f"{job.seeds} seeds",
        "",
        "Squared distance of the weights to the previous ones as the adapters order "
        "them, relative to their square, after so many updates; in brackets the share "
        "of places in the adapters' orders that changed in the last 100.",
        "",
        f"| form | adapter rate | {heads} |",
        f"|---|---|{'---:|' * len(job.updates)}",
    ]
    for row in rows:
        means = [np.mean(row[name], axis=0) for name in ("distance", "moving")]
        cells = [f"{d:.2f} ({m:.0%})" for d, m in zip(*means, strict=True)]
        table.append(
            f"| {row['form']} | {row['adapter_rate']:g} | {' | '.join(cells)} |"
        )
    text = "\n".join(table) + "\n"
    job.out.with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    keep_compiled()
    run(tyro.cli(Alignment, prog="python -m experiments.alignment"))
