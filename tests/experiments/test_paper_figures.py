"""Figures 4 and 5, and the runs with pink noise, of runs with known numbers."""

import dataclasses

import pytest

from experiments import figure4_tradeoff, figure5_evolution, pink_noise, suite
from experiments.figure4_tradeoff import Figure4
from experiments.first_task import FirstTask
from tests.fake_run import rows
from tests.fake_training import NAMES


def test_figure4_has_narrower_and_wider_policies(trained, tmp_path):
    job = Figure4(scenarios=NAMES[:1], out=tmp_path)
    figure4_tradeoff.run(job)
    width = {f.name: s.options.width for f, s, _ in trained if "-" in f.name}
    assert width == {"csp-s": 88, "ours-l": 192}
    found = {row["method"]: row for row in rows(tmp_path / "figure4-quick/figure4.csv")}
    assert len(found) == 11
    assert float(found["FT-1"]["performance"]) == pytest.approx(0.5)
    assert (tmp_path / "figure4-quick" / "figure4.png").stat().st_size > 0
    paper = figure4_tradeoff.variants(Figure4(profile="paper"), NAMES[0])
    assert paper["csp-s"] == ("csp", {"width": 175})
    assert paper["ours-l"] == ("rewire", {"width": 384})


def test_pink_noise_differs_in_the_noise_alone(trained, tmp_path):
    pink_noise.run(FirstTask(seeds=2, out=tmp_path))
    assert [folder.name for folder, *_ in trained] == ["seed-0"] * 3 + ["seed-1"] * 3
    assert [settings.seed for _, settings, _ in trained] == [0] * 3 + [1] * 3
    runs = {f.parent.name: settings for f, settings, _ in trained[:3]}
    colors = {name: settings.sac.noise_color for name, settings in runs.items()}
    assert colors == {"ft1-white": 0, "ft1-pink": 1, "rewire-white": 0}
    sac = dataclasses.replace(runs["ft1-white"].sac, noise_color=1)
    assert dataclasses.replace(runs["ft1-white"], sac=sac) == runs["ft1-pink"]
    assert {settings.tasks for settings in runs.values()} == {1}
    out = tmp_path / "pink-noise-quick-tasks-1"
    # After the first task: FT-1 has half of 1000 and GAP more, the other all of it.
    shown = (out / "pink-noise.md").read_text()
    assert "- FT-1: **600 ± 141**\n- FT-1, pink noise: **600 ± 141**" in shown
    assert "- Ours: **1,100 ± 141**" in shown
    found = rows(out / "pink-noise.csv")
    assert [row["run"] for row in found] == [name for name in runs for _ in range(6)]
    # Training returns of seeds 0 and 1, without a value at first.
    values = ["", "500.0", "1000.0", "", "800.0", "1300.0"]
    assert [row["value"] for row in found[:6]] == values
    after = ["", "", "500.0", "", "", "700.0"]
    assert [row["deterministic"] for row in found[:6]] == after
    assert (out / "pink-noise.png").stat().st_size > 0


def test_figure5_turns_modes_and_distillation_off(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "RESULTS", tmp_path / "kept")
    job = FirstTask(out=tmp_path, seeds=2, keep=True)
    figure5_evolution.run(job)
    chosen = {f.parent.name: s for f, s, _ in trained}
    assert {s.tasks for s in chosen.values()} == {1}
    ours, alone = chosen["rewire"].options, chosen["rewire-k1"].options
    undistilled = chosen["rewire-undistilled"].options
    assert (ours.modes, undistilled.modes, alone.modes) == (3, 3, 1)
    assert (ours.alpha, undistilled.alpha) == (1e-5, 0)
    assert dataclasses.replace(undistilled, alpha=1e-5) == ours
    assert chosen["ft1"].method == "ft1"
    # Seed 1 earns 300 more, and the first report of all has no reward.
    path = tmp_path / "kept/figure5-quick-tasks-1/figure5.csv"
    found = [row for row in rows(path) if row["run"] == "ft1"]
    assert [row["value"] for row in found[3:]] == ["", "800.0", "1300.0"]
    assert path.with_suffix(".png").stat().st_size > 0
    shown = path.with_suffix(".md").read_text()
    assert "| FT-1 | 2 | 1,150 | 1,150 | 1,000 to 1,300 | 0 of 2 | not | 600 |" in shown
    assert "| FT-1 | 1,000 / 500 | 1,300 / 700 |" in shown
    # What is there is shown without what is not.
    job = dataclasses.replace(job, seeds=3, train=False)
    figure5_evolution.run(job)
    assert "rewire-k1/seed-2" in path.with_suffix(".md").read_text()
