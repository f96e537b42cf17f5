"""The drawings of the page on concepts, computed with the package's functions.

`python -m docs.drawings` writes them anew.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import rewire_jax
from rewire_jax.methods import wiring
from rewire_jax.nn.networks import Linear

FOLDER = Path(__file__).with_name("drawings")
_COLOURS = mpl.colormaps["tab10"].colors  # type: ignore[attr-defined]
_SCORES = np.array([0.62, 0.10, 0.95, 0.35, 0.78, 0.22])
_MODES = (
    ([0, 1, 2, 3, 4], [0, 1, 2, 3, 4]),
    ([1, 0, 2, 4, 3], [2, 0, 1, 3, 4]),
    ([3, 1, 4, 0, 2], [1, 4, 2, 0, 3]),
)
# Makes the files reproducible.
_STYLE: Any = {"svg.hashsalt": "rewire_jax", "svg.fonttype": "none", "font.size": 9}


def write(folder: Path) -> list[Path]:
    """Writes all drawings as SVG; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for draw in (permutation, modes, alignment):
        with mpl.rc_context(_STYLE):
            path = folder / f"{draw.__name__}.svg"
            draw().savefig(path, metadata={"Date": None})
        paths.append(path)
    return paths


def permutation() -> Figure:
    """Neurons before and after a permutation, its matrix, and two relaxations."""
    n, scores = len(_SCORES), jnp.asarray(_SCORES)
    order = np.asarray(rewire_jax.permute(jnp.arange(n, dtype=float), scores, 1.0), int)
    figure = Figure((9, 2.7), layout="constrained")
    first, *others = figure.subplots(1, 4, width_ratios=(1.3, 1, 1, 1))
    _moved(first, 0.0, 1.0, order)
    for neuron, score in enumerate(_SCORES):
        first.text(-0.12, neuron, f"{score:.2f}", ha="right", va="center")
    first.set(xlim=(-0.55, 1.25), title="scores v → order z")
    hard = np.eye(n)[order]
    titles = ("P, forward", "relaxed, τ = 0.1", "relaxed, τ = 1")
    # Eq. 4; the package never builds it.
    ordered = _SCORES[order]
    distance = np.abs(ordered[:, None] - _SCORES[None])
    soft = [jax.nn.softmax(-distance / tau, axis=1) for tau in (0.1, 1.0)]
    for axes, matrix, title in zip(others, (hard, *soft), titles, strict=True):
        _matrix(axes, matrix, title, 0, 1)
        axes.set(xlabel="neuron", ylabel="place")
    return figure


def modes() -> Figure:
    """One set of weights with three wirings."""
    figure = Figure((9, 3.2), layout="constrained")
    for number, (axes, orders) in enumerate(
        zip(figure.subplots(1, len(_MODES)), _MODES, strict=True), 1
    ):
        count = len(orders[0])
        places = np.arange(count)
        for left, right in ((-1.0, 0.0), (1.0, 2.0), (3.0, 4.0)):
            for a in places:
                for b in places:
                    axes.plot([left, right], [a, b], color="0.85", lw=0.6, zorder=0)
        for layer, order in enumerate(orders):
            _moved(axes, 2.0 * layer, 2.0 * layer + 1, np.array(order))
        axes.scatter(np.full(count, -1), places, color="0.6", s=14)
        axes.scatter(np.full(count, 4), places, color="0.6", s=14)
        labels = ("s", "W₁s", "P₁W₁s", "W₂ ·", "P₂W₂ ·", "a")
        axes.set_title(f"mode {number}")
        for x, label in zip(range(-1, 5), labels, strict=True):
            axes.text(x, count - 0.3, label, ha="center", va="top", fontsize=7)
        axes.set_ylim(count - 0.1, -0.5)
    return figure


def alignment() -> Figure:
    """Weights before and after a task, their adapters, and a refined wiring."""
    n, random = 8, np.random.default_rng(3)
    before = [Linear(_smooth(n, phase), jnp.zeros(n)) for phase in (0.0, 1.0)]
    out, inp = random.permutation(n), random.permutation(n)
    scores = wiring.scores_of(jnp.array([random.permutation(n), out]))
    adapters = wiring.Adapters(scores, wiring.scores_of(jnp.array([inp])))
    noise = 0.05 * random.normal(size=(n, n))
    adapted = wiring.adapt(before, adapters, 0.1)
    now = [Linear(layer.weight + noise, layer.bias) for layer in adapted]
    cached = jnp.array([random.permutation(n) for _ in range(2)])
    refined = wiring.refine(cached, adapters)
    figure = Figure((9, 4.6), layout="constrained")
    rows: Any = figure.subfigures(2, 1, height_ratios=(1.5, 1))
    pictures = (
        (before[1].weight, "W before"),
        (now[1].weight, "W after the next task"),
        (adapted[1].weight, "before, as adapters order it"),
        (now[1].weight - adapted[1].weight, "their difference"),
    )
    for axes, (matrix, title) in zip(rows[0].subplots(1, 4), pictures, strict=True):
        _matrix(axes, matrix, title, -1, 1)
    seen = jnp.asarray(random.normal(size=n))
    outputs = (
        (before, cached, "cached wiring,\nweights before"),
        (now, cached, "cached wiring,\nweights after"),
        (now, refined, "refined wiring,\nweights after"),
    )
    for axes, (layers, orders, title) in zip(
        rows[1].subplots(1, 3, sharey=True), outputs, strict=True
    ):
        values = seen
        for weight, bias in wiring.fold(layers, orders):
            values = jax.nn.leaky_relu(weight @ values + bias, 0.2)
        axes.bar(np.arange(n), np.asarray(values), color=_COLOURS[0])
        axes.set_title(title, fontsize=8)
        axes.set(xticks=[], xlabel="outputs")
    return figure


def _smooth(n: int, phase: float) -> jax.Array:
    """Weights whose rows and columns can be told apart by eye."""
    x, y = jnp.meshgrid(jnp.linspace(0, 2, n), jnp.linspace(0, 2.5, n))
    return jnp.cos(2 * x + phase) * jnp.cos(y - phase) * 0.9


def _moved(axes: Axes, left: float, right: float, order: Any) -> None:
    """Two columns of neurons in different orders, joined by lines."""
    for place, neuron in enumerate(order):
        colour = _COLOURS[neuron % len(_COLOURS)]
        axes.plot([left, right], [neuron, place], color=colour, lw=1.2, zorder=1)
        axes.scatter([left, right], [neuron, place], color=[colour], s=45, zorder=2)
    axes.set_ylim(len(order) - 0.5, -0.5)
    axes.axis("off")


def _matrix(axes: Axes, matrix: Any, title: str, low: float, high: float) -> None:
    colours = "Blues" if low == 0 else "RdBu"
    axes.imshow(np.asarray(matrix), cmap=colours, vmin=low, vmax=high)
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, fontsize=9)


if __name__ == "__main__":
    write(FOLDER)
