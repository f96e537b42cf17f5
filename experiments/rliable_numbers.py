"""Writes tests/data/rliable.json: numbers of rliable that a test compares ours with.

rliable does not fit the versions in constraints.txt, so it has an environment of its
own. This script imports nothing of this package:

    python3.11 -m venv /tmp/rliable
    /tmp/rliable/bin/pip install rliable==1.2.0 arch==7.2.0 'pandas<3'
    /tmp/rliable/bin/python experiments/rliable_numbers.py
"""

import importlib.metadata
import json
from pathlib import Path

import numpy as np

OUT = Path("tests/data/rliable.json")
RESAMPLES = 20_000
_PACKAGES = "rliable", "arch", "numpy", "scipy"


def scores() -> dict[str, np.ndarray]:
    """Scores `[seeds, tasks]` of three methods, with ties, and of a normaliser."""
    random = np.random.default_rng(19)
    return {
        "a": random.normal(1.0, 0.3, (5, 8)).round(2),
        "b": random.normal(1.1, 0.4, (7, 8)).round(1),
        "c": (random.gamma(2.0, 0.5, (3, 8)) + np.arange(8) / 8).round(1),
        "normaliser": random.normal(900.0, 200.0, (5, 8)).round(),
    }


def main() -> None:
    """Computes and writes the numbers."""
    from rliable import library, metrics  # type: ignore[import-not-found]

    def estimate(samples, of, resamples=RESAMPLES):
        # rliable draws from the global generator.
        np.random.seed(0)  # noqa: NPY002
        values, ends = library.get_interval_estimates(
            {"": samples}, lambda *each: np.atleast_1d(of(*each)), reps=resamples
        )
        return {"value": values[""].tolist(), "interval": ends[""].tolist()}

    def ratio(sample, normaliser):
        return metrics.aggregate_iqm(sample) / metrics.aggregate_mean(normaliser)

    made = scores()
    methods = {name: made[name] for name in ("a", "b", "c")}
    thresholds = np.linspace(0.0, 2.5, 26)

    def profile(sample):
        return library.score_distributions(sample, thresholds)

    result = {
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "resamples": RESAMPLES,
        "scores": {name: sample.tolist() for name, sample in made.items()},
        "iqm": {n: estimate(s, metrics.aggregate_iqm) for n, s in methods.items()},
        "normalised_iqm": {
            n: estimate([s, made["normaliser"]], ratio) for n, s in methods.items()
        },
        "thresholds": thresholds.tolist(),
        "profile": {n: estimate(s, profile, 5_000) for n, s in methods.items()},
        "improvement": {
            f"{x} {y}": estimate(
                [methods[x], methods[y]], metrics.probability_of_improvement, 5_000
            )
            for x in methods
            for y in methods
            if x != y
        },
    }
    OUT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
