"""Figures 3 and 5: curves of the first task, read from runs and summed up."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import rewire_jax
from experiments import figure3_mode_kl, first_task, suite
from experiments.figure3_mode_kl import pattern, tell
from experiments.first_task import FirstTask
from rewire_jax.errors import UserError
from rewire_jax.evolution import Curve
from tests.fake_run import write_run

POINTS = 20
X = np.arange(1.0, POINTS + 1)
LABELS = {"rewire": "Ours", "ft1": "FT-1"}


def reports(folder):
    lines = (folder / "training.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_figure3_of_a_real_run(tmp_path, monkeypatch):
    preset = rewire_jax.preset

    def tiny(*arguments):
        quick = preset(*arguments)
        return dataclasses.replace(
            quick,
            interactions=640,
            envs=16,
            updates=8,
            warmup=160,
            eval_episodes=2,
            selection_episodes=0,
            report_every=160,
            checkpoint_every=0,
            sac=dataclasses.replace(quick.sac, hidden=32, depth=1, batch_size=16),
        )

    monkeypatch.setattr(rewire_jax, "preset", tiny)
    job = FirstTask(scenario="probe/reach", seeds=2, out=tmp_path)
    figure3_mode_kl.run(job)
    runs = tmp_path / "probe-reach-quick-tasks-1"
    assert {run.name for run in runs.iterdir()} == set(figure3_mode_kl.LABELS)
    path = tmp_path / "figure3-quick-tasks-1" / "figure3.csv"
    assert path.with_suffix(".png").stat().st_size > 0
    table = {(row["run"], row["interactions"]): row for row in rows(path)}
    assert len(table) == 2 * 4
    for run in runs.iterdir():
        divergence = {}
        for report in reports(run):
            values = divergence.setdefault(str(report["interactions"]), [])
            values.append(report["mode_divergence"])
        assert list(divergence) == ["160", "320", "480", "640"]
        # Modes begin as one, and no update has been made by the first report.
        assert divergence["160"] == [0, 0]
        assert min(divergence["640"]) > 0
        for interactions, values in divergence.items():
            row = table[run.name, interactions]
            assert float(row["mean"]) == pytest.approx(np.mean(values))
            assert float(row["low"]) == min(values)
            assert float(row["high"]) == max(values)
    shown = path.with_suffix(".md").read_text()
    assert "1 of 4 tasks, 640 interactions a task" in shown
    assert shown.count("of 2 seeds") == 2


def fake(folder: Path, values: np.ndarray, **kept) -> suite.Run:
    """A run whose seeds have these returns; an episode is ten steps long."""
    write_run(folder, stages=1, tasks=("normal",), seeds=len(values), **kept)
    told = [
        {"stage": 0, "seed": seed, "interactions": int(x), "reward": value / 10}
        for seed, each in enumerate(values)
        for x, value in zip(X, each, strict=True)
    ]
    lines = "".join(json.dumps(row) + "\n" for row in told)
    (folder / "training.jsonl").write_text(lines)
    return suite.Run(folder, None, None)


def test_the_end_is_the_last_tenth_without_the_diverged(tmp_path):
    rng = np.random.default_rng(0)
    ours, plain = 100 * rng.random((2, 4, POINTS))
    runs = [
        fake(tmp_path / "rewire", ours, diverged=(1,)),
        fake(tmp_path / "ft1", plain),
    ]
    title, curves, origins = first_task.read("Figure 9", runs, LABELS)
    assert title.startswith("Figure 9 on the first task of halfcheetah/forgetting")
    assert "seeds 0, 1, 2, 3 (diverged: 1), 1 of 1 tasks" in origins[0]
    _, first, second = first_task.summary(list(curves.values()), "return")
    ends = ours[[0, 2, 3], -2:].mean(axis=1)
    assert first[:3] == ["Ours", f"{np.median(ends):.1f}", f"{ends.mean():.1f}"]
    assert first[4] == f"{ours[[0, 2, 3]].mean():.1f}"
    assert second[2] == f"{plain[:, -2:].mean():.1f}"
    table = first_task.rows(curves)
    assert [row["seeds"] for row in table] == [3] * POINTS + [4] * POINTS


def test_runs_with_nothing_to_show_are_left_out(tmp_path):
    runs = [fake(tmp_path / name, np.ones((2, POINTS))) for name in LABELS]
    (tmp_path / "rewire" / "training.jsonl").write_text("")
    assert list(first_task.read("Figure 9", runs, LABELS).curves) == ["ft1"]
    lost = fake(tmp_path / "lost" / "ft1", np.ones((2, POINTS)), diverged=(0, 1))
    with pytest.raises(UserError, match="none of the runs has reported on a seed"):
        first_task.read("Figure 9", [runs[0], lost], LABELS)


def test_peak_and_end_of_a_curve():
    values = np.zeros(POINTS)
    values[4], values[9:12], values[-3:] = 1000, (8, 8, 90), (9, 3, 3)
    # A single high report neither is a peak nor spoils one, nor the end.
    found = pattern(X, values, 3)
    assert found == (10, 8, 3)
    assert found.converges
    assert not pattern(X, values + 3, 3).converges
    assert not pattern(X, X, 3).converges
    assert not pattern(X, 0 * X, 3).converges
    values[0] = np.nan
    assert pattern(X, values, 3) == found


def test_what_is_told_of_the_modes():
    rising, falling = np.linspace(1, 9, POINTS), np.linspace(9, 0.9, POINTS)
    told = tell(Curve("with", X, np.stack([rising, rising, 1e3 * falling])))
    assert told.startswith("- with: diverge-and-converge **does not appear** in the")
    assert "appears in 1 of 3 seeds" in told
    assert "**appears** in the median" in tell(Curve("with", X, falling[None]))
