"""A run whose programs are found on disk traces nothing, and has the same rows."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import rewire_jax
from rewire_jax.core import kept_programs
from rewire_jax.methods import METHODS
from rewire_jax.training import compiled_functions, rollout, train_loop
from rewire_jax.training.run_setup import prepare
from tests.each_method import each
from tests.tiny import tiny


@pytest.fixture
def programs(tmp_path: Path) -> Iterator[Path]:
    kept_programs.keep_in(tmp_path / "programs")
    yield tmp_path / "programs"
    kept_programs.keep_in(None)


def forget() -> None:
    """What another process does not have."""
    compiled_functions.build.cache_clear()
    compiled_functions.rollout_function.cache_clear()


def rows(folder: Path) -> list[bytes]:
    return [(folder / f"{name}.jsonl").read_bytes() for name in ("results", "training")]


def train(folder: Path, method: str) -> list[bytes]:
    forget()
    rewire_jax.train(replace(tiny(method=method), tasks=2), folder)
    return rows(folder)


@pytest.mark.parametrize("method", each(["ft1"]))
def test_second_run_traces_nothing(method, programs, tmp_path, monkeypatch):
    first = train(tmp_path / "first", method)
    made = sorted(programs.iterdir())
    assert len(made) > 5

    def traced(*arguments, **options):
        raise AssertionError("traced")

    monkeypatch.setattr(train_loop, "run_chunk", traced)
    monkeypatch.setattr(rollout, "begin", traced)
    assert train(tmp_path / "second", method) == first
    assert sorted(programs.iterdir()) == made
    monkeypatch.undo()
    kept_programs.keep_in(None)
    assert train(tmp_path / "traced", method) == first


def test_programs_of_ones_own_method_are_not_kept(programs, monkeypatch):
    def start() -> None:
        forget()
        plan = prepare(tiny(method="ft1"))
        plan.program.init(plan.stacked)

    entry = METHODS["ft1"]
    own = entry._replace(make=lambda *given: entry.make(*given))
    with monkeypatch.context() as patch:
        patch.setitem(METHODS, "ft1", own)
        start()
        assert not programs.exists()
    start()
    assert len(list(programs.iterdir())) == 1
