"""The paper's Figure 5: training on the first task, with parts of the method left out.

Figure 3 uses two of the same runs. As in the paper, the table shows when a return of
2,000 is reached, and the return at the end.
"""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import scipy

from experiments import first_task, suite
from experiments.first_task import FirstTask, Trained
from rewire_jax.core.formatting import number
from rewire_jax.reports.plots import Array
from rewire_jax.reports.table import to_markdown

# On the first task there is nothing to align with.
VARIANTS: suite.Variants = {
    "ft1": ("ft1", {}),
    "rewire": ("rewire", {}),
    "rewire-k1": ("rewire", {"modes": 1}),
    "rewire-undistilled": ("rewire", {"alpha": 0.0}),
}
LABELS = {
    "ft1": "FT-1",
    "rewire-k1": "Rewire (K = 1)",
    "rewire": "Ours",
    "rewire-undistilled": "Ours without L_KL",
}
PANELS = (("ft1", "rewire-k1", "rewire"), ("rewire-undistilled", "rewire"))
STANDS = 2_000
"""A return that a HalfCheetah on its back does not reach."""


def reached(trained: Trained) -> Array:
    """`[seeds]`, interactions when a whole episode's return is first above 2,000.

    Infinite where none is.
    """
    x = trained.curve.x
    whole = [at for at in range(x.size) if x[at] >= trained.episode]
    above = np.array([trained.over_episode(at) > STANDS for at in whole]).T
    if not whole:
        return np.full(len(trained.seeds), np.inf)
    return np.where(above.any(axis=1), x[whole][np.argmax(above, axis=1)], np.inf)


def beats(one: Array, other: Array) -> tuple[float, float, float]:
    """How probable a seed of the one earns more than one of the other.

    Args:
      one: `[seeds]`.
      other: `[seeds]`, not of the same number necessarily.

    Returns:
      The share of pairs, ties being halves, and its 95% bootstrap interval over the
      seeds of both; NaN for the interval with fewer than two seeds of either.
    """

    def share(one: Array, other: Array, axis: int = -1) -> Array:
        gap = one[..., :, None] - other[..., None, :]
        return np.mean((np.sign(gap) + 1) / 2, axis=(-2, -1))

    mean = float(share(one, other))
    if min(len(one), len(other)) < 2:
        return mean, np.nan, np.nan
    interval = scipy.stats.bootstrap(
        (one, other),
        share,
        vectorized=True,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return mean, float(interval.low), float(interval.high)


def table(found: dict[str, Trained]) -> list[list[str]]:
    """What the paper read off its curves, a row for each variant."""
    head = ["training return", "seeds", "median at the end", "mean", "95% interval"]
    head += [
        f"above {STANDS:,}",
        "reached there, median",
        "without exploration, median",
    ]
    rows = [head]
    for trained in found.values():
        above = trained.end > STANDS
        soon = float(np.median(reached(trained)))
        rows.append(
            [
                trained.curve.label,
                str(len(trained.seeds)),
                *first_task.ends(trained),
                f"{above.sum()} of {above.size}",
                f"{soon:,.0f}" if np.isfinite(soon) else "not",
                number(float(np.median(trained.returns))),
            ]
        )
    return rows


def by_seed(found: dict[str, Trained]) -> Iterator[str]:
    """Markdown: what each seed earns, exploring and not."""
    yield "Each seed, at the end of training | without exploration after it:"
    yield ""
    seeds = sorted({seed for trained in found.values() for seed in trained.seeds})
    rows = []
    for trained in found.values():
        ends = zip(trained.end, trained.returns, strict=True)
        known = dict(zip(trained.seeds, ends, strict=True))
        cells = [
            " / ".join(map(number, known[seed])) if seed in known else "–"
            for seed in seeds
        ]
        rows.append([trained.curve.label, *cells])
    yield from to_markdown(["", *(f"seed {seed}" for seed in seeds)], rows)


def by_pair(found: dict[str, Trained]) -> Iterator[str]:
    """Markdown: how probable one variant's seed earns more than another's."""
    for one, other in itertools.combinations(found.values(), 2):
        values = beats(one.end, other.end), beats(one.returns, other.returns)
        told = [
            f"{mean:.2f}" + (f" ({low:.2f} to {high:.2f})" if low == low else "")
            for mean, low, high in values
        ]
        yield (
            f"- A seed of {one.curve.label} earns more than one of "
            f"{other.curve.label} with probability {told[0]} at the end of training, "
            f"{told[1]} without exploration."
        )
    yield ""


def notes(found: dict[str, Trained]) -> Sequence[str]:
    """Markdown, what stands below the table."""
    return (
        *by_seed(found),
        *by_pair(found),
        "In parentheses: 95% bootstrap interval over seeds. All environments of a run "
        "start their episodes at the same time, at rest. This causes the dips in the "
        "curves.",
        "",
    )


def run(job: FirstTask) -> None:
    """Trains what is unfinished, and draws it; raises as `suite.train`."""
    evolved = first_task.train(job, "Figure 5", VARIANTS, LABELS)
    path = job.folder("figure5") / "figure5"
    found = evolved.found
    first_task.write(
        path, "training return", evolved, PANELS, notes(found), table=table(found)
    )


if __name__ == "__main__":
    suite.command(FirstTask, run, "figure5_evolution")
