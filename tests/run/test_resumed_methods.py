"""Methods whose runs are stopped and resumed within a task."""

import dataclasses
from pathlib import Path

import pytest

from rewire_jax.run import train_run
from tests.stopped_run import assert_same_run, checkpoints, train_until
from tests.tiny import tiny


# PackNet in the updates after its second pruning; CSP with labels in its buffer, in a
# task that ends with a search.
@pytest.mark.parametrize(
    ("method", "times", "name", "resumed"),
    [
        ("packnet", 3, "offline_update", "task-001-step-0000040"),
        pytest.param(
            *("csp", 5, "chunk", "task-001-step-0000020"), marks=pytest.mark.slow
        ),
    ],
)
def test_what_a_method_needs_within_a_task_is_saved(
    method: str,
    times: int,
    name: str,
    resumed: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = dataclasses.replace(tiny(method=method), tasks=2, selection_episodes=1)
    whole = train_run.train(settings, tmp_path / "whole")
    train_until(monkeypatch, settings, tmp_path / "parts", times, name)
    assert checkpoints(tmp_path / "parts")[-1] == resumed
    parts = train_run.train(settings, tmp_path / "parts", resume=True)
    assert_same_run(parts, whole, settings)
