"""Figures 3 and 5: curves of the first task, read from runs and summed up."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from experiments import figure3_mode_kl, figure5_evolution, first_task
from experiments.figure3_mode_kl import pattern, tell
from experiments.figure5_evolution import beats, reached
from experiments.first_task import FirstTask
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings_json import to_json
from rewire_jax.reports.training_curve_plot import Curve
from rewire_jax.run.campaign_file import read_campaign
from rewire_jax.storage.run_results import RunData, read_run
from tests.fake_run import rows, write_run
from tests.tiny import shrink_presets

POINTS = 20
ENVS = 0.2  # so that they play an episode of ten steps in two reports
X = np.arange(1.0, POINTS + 1)
LABELS = {"rewire": "Ours", "ft1": "FT-1"}


def reports(folder):
    lines = (folder / "training.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


@pytest.mark.slow
def test_figure3_of_a_real_run(tmp_path, monkeypatch):
    few = {"updates": 8, "selection_episodes": 0, "checkpoint_every": 0}
    shrink_presets(monkeypatch, hidden=32, interactions=640, **few)
    job = FirstTask(scenario="probe/reach", seeds=2, out=tmp_path)
    figure3_mode_kl.run(job)
    runs = tmp_path / "probe-reach-first-task-quick-tasks-1"
    assert {run.name for run in runs.iterdir()} == set(figure3_mode_kl.LABELS)
    path = tmp_path / "figure3-quick-tasks-1" / "figure3.csv"
    assert path.with_suffix(".png").stat().st_size > 0
    table = {(r["run"], r["seed"], r["interactions"]): r["value"] for r in rows(path)}
    assert len(table) == 2 * 2 * 4
    for name in figure3_mode_kl.LABELS:
        divergence = {}
        for seed in ("0", "1"):
            for report in reports(runs / name / f"seed-{seed}"):
                at, value = str(report["interactions"]), report["mode_divergence"]
                assert float(table[name, seed, at]) == pytest.approx(value)
                divergence[seed, at] = value
        # Modes begin as one, and no update has been made by the first report.
        assert divergence["0", "160"] == divergence["1", "160"] == 0
        assert divergence["0", "640"] != divergence["1", "640"]
        assert min(divergence["0", "640"], divergence["1", "640"]) > 0
    shown = path.with_suffix(".md").read_text()
    assert "1 of 4 tasks, reduced budget of 640 interactions a task" in shown
    assert shown.count("of 2 seeds") == 2


def fake(folder: Path, values: np.ndarray, first=0, **kept) -> dict[Path, RunData]:
    """Finished runs of a seed each, with these returns; an episode has ten steps."""
    runs = {}
    for seed, each in enumerate(values, first):
        run = folder / f"seed-{seed}"
        write_run(
            run,
            envs=ENVS,
            stages=1,
            tasks=("normal",),
            seed=seed,
            seeds=1,
            **kept,
        )
        told = [
            {"stage": 0, "member": 0, "seed": seed, "interactions": int(x)}
            | {"reward": value / 10}
            for x, value in zip(X, each, strict=True)
        ]
        lines = "".join(json.dumps(row) + "\n" for row in told)
        (run / "training.jsonl").write_text(lines)
        runs[run] = read_run(run)
    return runs


def test_the_end_is_the_last_tenth_without_the_diverged(tmp_path):
    rng = np.random.default_rng(0)
    ours, plain = 100 * rng.random((2, 4, POINTS))
    runs = fake(tmp_path / "rewire", ours, diverged=(1,))
    runs |= fake(tmp_path / "ft1", plain)
    title, found, origins = first_task.read("Figure 9", runs, LABELS)
    assert title.startswith("Figure 9 on the first task of halfcheetah/forgetting")
    assert ", 3 to 4 seeds" in title
    assert "seeds 0, 1, 2, 3 (diverged: 1)" in origins[0]
    assert found["rewire"].seeds == (0, 2, 3)
    _, first, second = first_task.summary(list(found.values()), "return")
    ends = ours[[0, 2, 3], -2:].mean(axis=1)
    assert first[:3] == ["Ours", f"{np.median(ends):.1f}", f"{ends.mean():.1f}"]
    assert first[4] == f"{ours[[0, 2, 3]].mean():.1f}"
    assert second[2] == f"{plain[:, -2:].mean():.1f}"
    table = first_task.rows(found)
    assert [row["run"] for row in table] == ["rewire"] * 60 + ["ft1"] * 80
    np.testing.assert_allclose([row["value"] for row in table[60:80]], plain[0])


def test_reports_that_only_some_seeds_made_are_left_out(tmp_path):
    runs = fake(tmp_path / "ft1", np.ones((2, POINTS)))
    first = next(iter(runs))
    path = first / "training.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))
    runs[first] = read_run(first)
    curve = first_task.read("Figure 9", runs, LABELS).found["ft1"].curve
    np.testing.assert_array_equal(curve.x, X[1:])
    assert curve.values.shape == (2, POINTS - 1)


def test_runs_with_nothing_to_show_are_left_out(tmp_path):
    ft1 = fake(tmp_path / "ft1", np.ones((2, POINTS)))
    (waiting,) = fake(tmp_path / "rewire", np.ones((1, POINTS)))
    (waiting / "results.jsonl").unlink()
    found = first_task.read("Figure 9", {waiting: None, **ft1}, LABELS)
    assert list(found.found) == ["ft1"]
    assert "rewire/seed-0" in found.origins[-1]
    lost = fake(tmp_path / "lost" / "ft1", np.ones((2, POINTS)), diverged=(0, 1))
    with pytest.raises(UserError, match="without divergence"):
        first_task.read("Figure 9", {waiting: None, **lost}, LABELS)
    with pytest.raises(UserError, match="finished"):
        first_task.read("Figure 9", {waiting: None}, LABELS)
    with pytest.raises(UserError, match="no runs named"):
        first_task.read("Figure 9", ft1, {"rewire": "Ours"})


def test_a_figure_of_the_runs_of_a_campaign(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "some.toml"
    file.write_text(
        """
        title = "First task"
        population = "never"
        [[runs]]
        scenarios = ["probe/reach", "halfcheetah/forgetting"]
        methods = ["ft1", "rewire"]
        seeds = 2
        profile = "quick"
        [runs.settings]
        tasks = 1
        [[runs]]
        scenarios = ["probe/reach"]
        methods = ["rewire"]
        name = "rewire-k1"
        profile = "quick"
        [runs.settings]
        tasks = 1
        modes = 1
        """
    )
    for run in read_campaign(file).runs:
        if run.name != "probe/reach/rewire/seed-1":
            folder = Path("runs/some") / run.name
            seed = run.settings.seed
            values = np.full((1, POINTS), 100.0 + seed)
            (fake_folder,) = fake(tmp_path / "fake" / run.name, values, first=seed)
            folder.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(fake_folder, folder)
            head = json.loads((folder / "settings.json").read_text())
            head |= {"settings": to_json(run.settings)}
            (folder / "settings.json").write_text(json.dumps(head))
    figure5_evolution.run(FirstTask(scenario="probe/reach", campaign=file))
    shown = Path("runs/figure5-some/figure5.md").read_text()
    assert "| FT-1 | 2 | 100 | 100 |" in shown
    assert "| FT-1 | 100 / 1,000 | 101 / 1,200 |" in shown
    assert "| Ours | 1 |" in shown
    assert "| Rewire (K = 1) | 1 |" in shown
    assert "**not finished: runs/some/probe/reach/rewire/seed-1**" in shown


def test_how_probable_one_earns_more():
    rng = np.random.default_rng(3)
    one, other = rng.normal(1.0, 1.0, 6), rng.normal(0.0, 1.0, 5)
    pairs = [(a > b) + 0.5 * (a == b) for a in one for b in other]
    mean, low, high = beats(one, other)
    assert mean == pytest.approx(np.mean(pairs))
    assert 0 <= low < mean < high <= 1
    assert beats(other, one)[0] == pytest.approx(1 - mean)
    assert beats(one, one)[0] == pytest.approx(0.5)
    assert beats(one + 100, other) == (1, 1, 1)
    assert np.isnan(beats(one, other[:1])[1:]).all()


def test_when_a_return_is_reached():
    values = np.array([[0, 2500, 100, 2500], [0, 1, 2, 3], [0, 0, 0, 2001]])
    curve = Curve("", np.array([10.0, 20.0, 30.0, 40.0]), values)
    trained = first_task.Trained(curve, (0, 1, 2), np.zeros(3), 20.0)
    # Means over two reports: 1250 and 1300; 1; 1000.5. One fast report is no episode.
    assert reached(trained).tolist() == [np.inf] * 3
    curve = curve._replace(values=2 * values)
    assert reached(trained._replace(curve=curve)).tolist() == [20, np.inf, 40]
    assert np.isinf(reached(trained._replace(episode=50.0))).all()


def test_a_report_counts_by_its_share_of_the_last_episode():
    curve = Curve("", np.array([10.0, 20.0, 26.0]), np.array([[8.0, 4.0, 1.0]]))
    trained = first_task.Trained(curve, (0,), np.zeros(1), 12.0)
    np.testing.assert_allclose(trained.end, (6 * 4 + 6 * 1) / 12)
    np.testing.assert_allclose(trained.over_episode(1), (2 * 8 + 10 * 4) / 12)
    np.testing.assert_allclose(trained.over_episode(0), 8)


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
