"""Methods whose runs are stopped and resumed within a task."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from rewire_jax.run import train_run
from tests.stopped_run import assert_same_run, checkpoints, train_until
from tests.tiny import rows, tiny

PLASTIC = {
    "redo_every": 10,
    "dormant_threshold": 0.5,
    "l2_init": 0.01,
    "parseval": 0.001,
    "plasticity_metrics": True,
}


# PackNet in the updates after its second pruning; CSP with labels in its buffer, in a
# task that ends with a search; modes that environments hold. Then what knobs of SAC
# need, at a task's start.
@pytest.mark.parametrize(
    ("method", "times", "name", "resumed", "sac", "options"),
    [
        pytest.param(
            *("packnet", 3, "offline_update", "task-001-step-0000040", {}, {}),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *("csp", 5, "chunk", "task-001-step-0000020", {}, {}),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *("rewire", 7, "chunk", "task-001-step-0000020", {}, {"mode_steps": 7}),
            marks=pytest.mark.slow,
        ),
        ("ft1", 5, "chunk", "task-001", PLASTIC, {}),
    ],
)
def test_what_a_method_needs_within_a_task_is_saved(
    method: str,
    times: int,
    name: str,
    resumed: str,
    sac: dict[str, Any],
    options: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = dataclasses.replace(tiny(method=method), tasks=2, selection_episodes=1)
    settings = dataclasses.replace(
        settings,
        sac=dataclasses.replace(settings.sac, **sac),
        options=dataclasses.replace(settings.options, **options),
    )
    whole = train_run.train(settings, tmp_path / "whole")
    train_until(monkeypatch, settings, tmp_path / "parts", times, name)
    assert checkpoints(tmp_path / "parts")[-1] == resumed
    parts = train_run.train(settings, tmp_path / "parts", resume=True)
    assert_same_run(parts, whole, settings)
    reported = {"dormant_critic", "rank_critic", "dormant_policy", "rank_policy"}
    for row in rows(parts, "training.jsonl"):
        assert (reported & row.keys()) == (reported if sac else set())
