"""Sweeps that are stopped or broken off, and traces of an unbroken one."""

import dataclasses
import itertools
import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import pytest

from rewire_jax.core.settings import Settings
from rewire_jax.run import interrupts, train_run
from tests.compiles import assert_once, compiles
from tests.small_sweep import rows, run_sweep, small

# Seven members in slots for eight. A width of its own, so that traces are counted.
SEVEN = {"axes": {"beta": [1, 2, 3, 4, 5, 6, 7]}, "members_per_batch": 4}


def seven() -> Settings:
    return dataclasses.replace(small(), sac=dataclasses.replace(small().sac, hidden=15))


class Unbroken(NamedTuple):
    folder: Path
    compiled: Mapping[str, int]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Unbroken:
    """A sweep of seven members, and what it compiled."""
    with compiles() as counts:
        folder = run_sweep(tmp_path_factory.mktemp("seven") / "s", seven(), **SEVEN)
    return Unbroken(folder, counts)


def same_tables(folder: Path, other: Path) -> None:
    paths = [p for p in other.glob("task-*/batch-*/*.jsonl") if p.stem != "timing"]
    assert len(paths) == 2 * 2 * 2
    for path in paths:
        assert (folder / path.relative_to(other)).read_bytes() == path.read_bytes()


def test_one_trace_for_all_batches_and_tasks(unbroken: Unbroken) -> None:
    assert_once(unbroken.compiled, "candidates")
    assert {place[1] for place in rows(unbroken.folder)} == set(range(7))


class Killed(BaseException):
    pass


# Each batch of a task is a chunk to each of four reports, with a checkpoint after two.
@pytest.mark.parametrize(
    ("how", "chunks"),
    [pytest.param("resume", 11, marks=pytest.mark.slow), ("join", 3)],
)
def test_a_broken_sweep_is_finished_bit_for_bit(
    how: str,
    chunks: int,
    unbroken: Unbroken,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chunk, made = train_run.Run.chunk, itertools.count()

    def killed(self, *rest):
        if next(made) == chunks:
            raise Killed
        return chunk(self, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(train_run.Run, "chunk", killed)
        with pytest.raises(Killed):
            run_sweep(tmp_path / "sweep", seven(), **SEVEN)
    (last,) = (tmp_path / "sweep").glob("task-*/batch-*/checkpoints/*-step-*")
    run_sweep(tmp_path / "sweep", seven(), **SEVEN, **{how: True})
    assert not last.exists()
    same_tables(tmp_path / "sweep", unbroken.folder)


@pytest.mark.parametrize(
    "name", ["chunk", pytest.param("evaluate", marks=pytest.mark.slow)]
)
def test_a_sweep_stops_when_asked_to(
    name: str, unbroken: Unbroken, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called = getattr(train_run.Run, name)

    def interrupted(self, *rest):
        os.kill(os.getpid(), signal.SIGINT)
        return called(self, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(train_run.Run, name, interrupted)
        with pytest.raises(interrupts.Stopped, match="same command with --resume"):
            run_sweep(tmp_path / "sweep", seven(), **SEVEN)
    assert not (tmp_path / "sweep/task-000/batch-001").exists()
    run_sweep(tmp_path / "sweep", seven(), **SEVEN, resume=True)
    same_tables(tmp_path / "sweep", unbroken.folder)
