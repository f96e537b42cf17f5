"""Runs of a configuration with different seeds, as if they were one run."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rewire_jax.storage.result_files import Array
from rewire_jax.storage.run_results import RunData


def merged(runs: Sequence[RunData]) -> RunData:
    """One run with the seeds of all, in order.

    The interactions per second are unknown: runs may have been trained side by side.

    Args:
        runs: of the same configuration in folders side by side, no seed twice.
    """
    runs = sorted(runs, key=lambda run: run.seeds[0])
    first = runs[0]
    if len(runs) == 1:
        return first
    devices = dict.fromkeys(run.provenance.get("device", "–") for run in runs)
    where = next((name for run in runs for name in run.memory), None)
    most = [run.memory[where] for run in runs if where in run.memory]
    return dataclasses.replace(
        first,
        folder=first.folder.parent,
        provenance=first.provenance | {"device": "; ".join(devices)},
        seeds=tuple(seed for run in runs for seed in run.seeds),
        diverged=tuple(seed for run in runs for seed in run.diverged),
        measured={
            score: np.concatenate([run.measured[score] for run in runs])
            for score in first.measured
        },
        finished=min(run.finished for run in runs),
        model_size=max(run.model_size for run in runs),
        stored_states=max(run.stored_states for run in runs),
        training=max(run.training for run in runs),
        selection=max(run.selection for run in runs),
        curve=_curves(runs, [run.curve for run in runs]),
        segments=_curves(runs, [run.segments for run in runs]),
        hours=sum(run.hours for run in runs),
        rate=None,
        memory={where: max(most)} if where else {},
    )


def merged_curve(parts: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Curves of several runs as one, at the interactions that all of them reported.

    A run that was stopped may have more reports than others.

    Args:
        parts: interactions `[points]` and values `[seeds, points]` of each run.

    Returns:
        The same of all seeds.
    """
    shared = set.intersection(*(set(x) for x, _ in parts))
    values = [values[:, [at in shared for at in x]] for x, values in parts]
    return np.array(sorted(shared), np.float64), np.concatenate(values)


def _curves(
    runs: Sequence[RunData], curves: Sequence[tuple[tuple[Array, Array], ...]]
) -> tuple[tuple[Array, Array], ...]:
    """Curves `[stages]` of all runs as one."""
    return tuple(_curve(runs, stage) for stage in zip(*curves, strict=True))


def _curve(
    runs: Sequence[RunData], curves: Sequence[tuple[Array, Array]]
) -> tuple[Array, Array]:
    """Curve of a stage; NaN for diverged seeds, whose reports end early."""
    kept = np.concatenate([run.kept for run in runs])
    pairs = zip(runs, curves, strict=True)
    parts = [(curve, run.kept) for run, curve in pairs if run.kept.any()]
    if not parts:
        return np.zeros(0), np.zeros((len(kept), 0))
    x, values = merged_curve([(x, values[rows]) for (x, values), rows in parts])
    everyone = np.full((len(kept), x.size), np.nan)
    everyone[kept] = values
    return x, everyone
