"""Runs that are stopped on the way, and what must be the same once they are resumed."""

from pathlib import Path

import jax
import numpy as np
import pytest

from rewire_jax.core.settings import Settings
from rewire_jax.run import run_checkpoints, train_run
from rewire_jax.storage import checkpoint
from rewire_jax.training import run_setup

TABLES = ("results.jsonl", "training.jsonl")


class _Stop(Exception):
    pass


def train_until(
    monkeypatch: pytest.MonkeyPatch,
    settings: Settings,
    folder: Path,
    times: int,
    name: str = "chunk",
) -> None:
    """Trains until a function of the run has been called so many times."""
    called = getattr(train_run.Run, name)
    calls = []

    def counting(self, *rest):
        if len(calls) == times:
            raise _Stop
        calls.append(None)
        return called(self, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(train_run.Run, name, counting)
        with pytest.raises(_Stop):
            train_run.train(settings, folder)


def checkpoints(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "checkpoints").iterdir())


def _leaves(folder: Path, settings: Settings) -> list[np.ndarray]:
    prepared = run_setup.prepare(settings)
    learner = jax.eval_shape(prepared.program.init, prepared.stacked)
    like = {"policy": (learner.params, learner.method_state), "critic": learner.critic}
    items, _ = checkpoint.load(run_checkpoints.kept(folder, None), like)
    return jax.tree.leaves(items)


def assert_same_tables(ours: Path, theirs: Path) -> None:
    for name in TABLES:
        assert (ours / name).read_bytes() == (theirs / name).read_bytes()


def assert_same_run(ours: Path, theirs: Path, settings: Settings) -> None:
    """The same tables, and bit for bit the same arrays at the end."""
    assert_same_tables(ours, theirs)
    pairs = zip(_leaves(ours, settings), _leaves(theirs, settings), strict=True)
    for one, other in pairs:
        np.testing.assert_array_equal(one, other)
