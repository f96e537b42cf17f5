"""Reports of synthetic sweeps, against sums over their rows."""

import itertools
import json
import statistics

import numpy as np
import pytest
from matplotlib.image import imread

from rewire_jax.core import formatting
from rewire_jax.core.errors import UserError
from rewire_jax.reports import sensitivity_plot
from rewire_jax.reports.write import write_report
from tests.fake_run import rows
from tests.fake_sweep import GRID, TASKS, choice, score, write_sweep


def write_sweep_report(folder, out=None):
    return write_report([folder], out or folder)


def members(report):
    return rows(report.folder / "members.csv")


def configurations(report):
    return rows(report.folder / "configurations.csv")


def mean(of, values, seed, stage):
    """A member's performance after a stage, summed up anew."""
    member = {"values": values, "seed": seed}
    return sum(of(member, stage, task) for task in range(stage + 1)) / (stage + 1)


def test_known_numbers_everywhere(tmp_path):
    folder = write_sweep(tmp_path / "sweep", seeds=3, paper_interactions=1_000_000)
    report = write_sweep_report(folder)
    assert report.title == (
        "halfcheetah/forgetting, rewire: quick profile, 3 of 8 tasks, reduced "
        "budget of 1,000 interactions a task (paper: 1,000,000), positional backend, "
        "12 configurations × 3 seeds"
    )
    found = members(report)
    assert len(found) == 12 * 3 * 3
    for row in found:
        values = GRID[int(row["configuration"])]
        assert {name: float(row[name]) for name in values} == values
        seed, stage = int(row["seed"]), int(row["stage"]) - 1
        assert int(row["member"]) == 3 * int(row["configuration"]) + seed
        assert row["task"] == TASKS[stage]
        expected = mean(score, values, seed, stage)
        assert float(row["performance"]) == pytest.approx(expected)
        assert float(row["choice"]) == pytest.approx(mean(choice, values, seed, stage))
        alone = score({"values": values, "seed": seed}, stage, stage)
        assert float(row["return"]) == pytest.approx(alone)
        assert int(row["training_interactions"]) == 1000 * (stage + 1)
        assert row["diverged"] == row["stopped"] == "False"

    found = configurations(report)
    assert len(found) == 12
    for row in found:
        values = GRID[int(row["configuration"])]
        ends = [mean(score, values, seed, 2) for seed in range(3)]
        assert float(row["performance_mean"]) == pytest.approx(statistics.mean(ends))
        assert float(row["performance_std"]) == pytest.approx(10)
        # Of three seeds the mean of all that are drawn is often one of the ends.
        assert float(row["performance_low"]) == pytest.approx(ends[0])
        assert float(row["performance_high"]) == pytest.approx(ends[2])
        assert (row["seeds"], row["diverged"], row["stage"]) == ("3", "0", "3")
    order = [float(row["choice_mean"]) for row in found]
    assert order == sorted(order, reverse=True)
    assert GRID[int(found[0]["configuration"])] == {
        "modes": 3,
        "alpha": 1e-5,
        "beta": 1.0,
    }
    # 300 + 20 - 1 + 10, 14 more by the stage and 3 less by the task.
    text = report.page.read_text()
    assert "Best: modes 3, alpha 1e-5, beta 1; performance after 3 tasks 340 [" in text
    row = "1 | 3 | 1e-5 | 1 | 340 ± 10 | 340 [330, 350] | 342 ± 10 | 3 of 3 | 3"
    assert f"\n| {row} |\n" in text
    assert text.count("\n| 10 |") == 1
    assert "\n| 11 |" not in text
    assert "abc123" in text
    assert "jax 0.10.2" in text
    assert "108,000 interactions of training" in text
    data = json.loads((report.folder / "sweep.json").read_text())
    assert data["best"] == int(found[0]["configuration"])
    assert [c["index"] for c in data["configurations"]] == [
        int(row["configuration"]) for row in found
    ]
    assert data["configurations"][0]["performance"]["values"] == [330, 340, 350]
    assert data["complete"]


def test_panels_vary_one_axis_from_the_best(tmp_path):
    report = write_sweep_report(write_sweep(tmp_path / "sweep"), tmp_path / "out")
    best = {"modes": 3, "alpha": 1e-5, "beta": 1.0}
    assert report.numbers.best.values == best
    lines = {panel.axis: panel.line for panel in report.numbers.panels}
    assert list(lines) == ["modes", "alpha", "beta"]
    for axis, line in lines.items():
        expected = sorted({values[axis] for values in GRID})
        assert [each.values for each in line] == [best | {axis: x} for x in expected]
    text = report.page.read_text()
    assert "the others are at their best: modes 3, alpha 1e-5, beta 1." in text
    # By K = 3: over all its configurations, the best of them, along the panel.
    everything = [mean(score, c, 0, 2) + 5 for c in GRID if c["modes"] == 3]
    std = statistics.stdev(everything)
    row = f"| 3 | 4 of 4 | {statistics.mean(everything):.0f} ± {std:.0f} "
    assert row + "| 335 ± 7 | 335 ± 7 |" in text
    assert report.folder == tmp_path / "out"


def test_lines_through_one_point(tmp_path):
    centre = {"modes": 2, "alpha": 1e-5, "beta": 1.0}
    star = [centre]
    for name, values in (("modes", (1, 3)), ("alpha", (0.0,)), ("beta", (100.0,))):
        star += [centre | {name: value} for value in values]
    report = write_sweep_report(write_sweep(tmp_path / "s", configurations=star))
    # Three modes are better, but nothing varies from there.
    assert report.numbers.best.values == centre | {"modes": 3}
    lengths = {panel.axis: len(panel.line) for panel in report.numbers.panels}
    assert lengths == {"modes": 3, "alpha": 2, "beta": 2}
    assert all(centre.items() >= p.others.items() for p in report.numbers.panels)
    assert "where the lines of the sweep cross" in report.page.read_text()


def test_best_is_chosen_by_choice_and_reported_by_return(tmp_path):
    def other(member, stage, task):
        return -score(member, stage, task)

    report = write_sweep_report(write_sweep(tmp_path / "sweep", choice=other))
    best = {"modes": 1, "alpha": 0.0, "beta": 100.0}
    assert report.numbers.best.values == best
    expected = [mean(score, best, seed, 2) for seed in range(2)]
    assert report.numbers.best.performance.values == pytest.approx(expected)


def test_diverged_configurations_stand_behind(tmp_path):
    best = GRID.index({"modes": 3, "alpha": 1e-5, "beta": 1.0})
    # Members of the best, and of the first both.
    lost = {2 * best + 1: 1, 0: 0, 1: 2}
    report = write_sweep_report(write_sweep(tmp_path / "sweep", diverged=lost))
    order = [each.index for each in report.numbers.configurations]
    assert order[-2:] == [best, 0]
    first = report.numbers.configurations[-2]
    assert (first.kept, first.diverged) == ((0,), (1,))
    assert first.performance.mean == mean(score, GRID[best], 0, 2)
    assert first.performance.std is None
    last = configurations(report)[-1]
    assert (last["performance_mean"], last["diverged"]) == ("", "2")
    text = report.page.read_text()
    assert "**3 members of 24 diverged.**" in text
    assert "| 3 | 1e-5 | 1 | 1 | 3 |" in text
    assert "| 1 | 0 | 1 | 0, 1 | 3 |" in text
    found = [row for row in members(report) if row["diverged"] == "True"]
    assert sorted((row["member"], row["stage"]) for row in found) == sorted(
        (str(member), str(stage + 1))
        for member, since in lost.items()
        for stage in range(since, 3)
    )


def test_all_diverged(tmp_path):
    lost = dict.fromkeys(range(24), 0)
    report = write_sweep_report(write_sweep(tmp_path / "sweep", diverged=lost))
    assert report.numbers.best is None
    assert report.notes[0].startswith("There is no best configuration yet")
    assert (report.folder / "panels.png").stat().st_size > 0


def test_halved_away_rank_by_how_far_they_came(tmp_path):
    # The worst go on: rank must not go by the mean alone.
    folder = write_sweep(
        tmp_path / "sweep",
        going_on=[(0, 1, 2, 3, 4, 5), (0, 1)],
        head={"halving": 2},
    )
    report = write_sweep_report(folder)
    order = [each.index for each in report.numbers.configurations]

    def best_first(numbers, stage):
        return sorted(numbers, key=lambda i: -mean(score, GRID[i], 0, stage))

    assert order == [
        *best_first((0, 1), 2),
        *best_first((2, 3, 4, 5), 1),
        *best_first(range(6, 12), 0),
    ]
    stages = [each.stage for each in report.numbers.configurations]
    assert stages == [3] * 2 + [2] * 4 + [1] * 6
    text = report.page.read_text()
    assert "10 configurations were halved away before the end" in text
    assert "Hollow: after fewer tasks" in text
    # Only what came to the end is averaged by value.
    assert "| 1 | 2 of 4 |" in text
    assert "| 3 | 0 of 4 | – | – | – |" in text
    stopped = [row for row in members(report) if row["stopped"] == "True"]
    assert len(stopped) == 2 * 10


def test_unfinished_sweep_is_compared_where_all_have_come(tmp_path):
    folder = write_sweep(tmp_path / "sweep", stages=2, size=8)
    (folder / "task-001" / "batch-002" / "results.jsonl").unlink()
    report = write_sweep_report(folder)
    assert "Unfinished: 1 of 3 tasks" in report.page.read_text()
    assert {each.stage for each in report.numbers.configurations} == {1}
    assert report.numbers.best.performance.values == pytest.approx(
        [mean(score, report.numbers.best.values, seed, 0) for seed in range(2)]
    )
    # What there is beyond is in the table of members.
    assert sum(row["stage"] == "2" for row in members(report)) == 16
    # One batch of the first task is through.
    for number in (1, 2):
        (folder / "task-000" / f"batch-{number:03d}" / "results.jsonl").unlink()
    (folder / "task-001" / "batches.json").unlink()
    report = write_sweep_report(folder)
    assert [each.stage for each in report.numbers.configurations] == [1] * 4 + [0] * 8
    assert "| – |" in report.page.read_text()
    assert "Unfinished: 0 of 3 tasks" in report.page.read_text()


def test_what_the_sweep_does_not_tell_apart(tmp_path):
    # Seeds are 10 apart: the first's interval overlaps the second's.
    line = [{"modes": k, "alpha": 0.0, "beta": 0.0} for k in (1, 2)]

    def near(member, stage, task):
        return 100 + 4 * member["values"]["modes"] + 10 * member["seed"]

    report = write_sweep_report(
        write_sweep(tmp_path / "near", configurations=line, score=near, choice=near)
    )
    assert [each.index for each in report.numbers.contenders] == [0]
    assert "1 other configuration overlaps" in report.page.read_text()
    far = write_sweep(tmp_path / "far", configurations=line)
    assert write_sweep_report(far).numbers.contenders == []


def test_single_seed_has_no_interval(tmp_path):
    report = write_sweep_report(write_sweep(tmp_path / "sweep", seeds=1))
    assert "after 3 tasks 330, of one seed, which" in report.notes[0]
    assert "standard deviation;" not in report.page.read_text().split("![")[1]
    assert configurations(report)[0]["performance_low"] == ""
    assert report.title.endswith("12 configurations × 1 seed")


def test_random_draws(tmp_path):
    rng = np.random.default_rng(0)
    drawn = [
        {"modes": 1, "alpha": float(10.0**x), "beta": float(y)}
        for x, y in rng.uniform((-7, 0), (-4, 1), (7, 2))
    ]
    folder = write_sweep(tmp_path / "s", configurations=drawn, head={"random": 7})
    report = write_sweep_report(folder)
    for panel in report.numbers.panels:
        assert len(panel.line) == 7
        assert panel.others == {}
        values = [each.values[panel.axis] for each in panel.line]
        assert values == sorted(values)
    # Thirds of the draws: 3, 2 and 2.
    part = report.page.read_text().split("## alpha")[1].split("##")[0]
    assert [line.count(" of ") for line in part.splitlines()[4:7]] == [1, 1, 1]
    ends = sorted(c["alpha"] for c in drawn)
    means = [
        statistics.mean(mean(score, c, s, 2) for s in range(2) for c in drawn if ok(c))
        for ok in (lambda c: c["alpha"] <= ends[2], lambda c: c["alpha"] >= ends[5])
    ]
    lines = part.splitlines()
    assert f"| 3 of 3 | {means[0]:.0f} ± " in lines[4]
    assert f"| 2 of 2 | {means[1]:.0f} ± " in lines[6]


def test_picture_is_not_blank(tmp_path):
    for number, head in enumerate(({}, {"random": 12})):
        folder = write_sweep(tmp_path / str(number), head=head)
        image = imread(write_sweep_report(folder).folder / "panels.png")
        assert min(image.shape[:2]) > 400
        assert 0.005 < (image[..., :3].min(axis=2) < 0.9).mean() < 0.5


def test_single_axis(tmp_path):
    line = [{"modes": k} for k in (1, 2)]

    def plain(member, stage, task):
        return 100.0 * member["values"]["modes"] + 2 * member["seed"]

    folder = write_sweep(tmp_path / "s", configurations=line, score=plain, choice=plain)
    text = write_sweep_report(folder).page.read_text()
    assert "| 2 | 1 of 1 | 201 | 201 ± 1 | 201 ± 1 |" in text
    assert "other axes" not in text


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1, 2, 3, 4], False),
        ([0, 1e-6, 1e-5], False),
        ([0, 1e-6, 1e-4], True),
        ([0.1, 1, 10], True),
        ([-1, 1, 1000], False),
        ([0], False),
    ],
)
def test_axes_over_decades_are_logarithmic(values, expected):
    assert sensitivity_plot.logarithmic(np.array(values, float)) is expected


def test_values_are_short():
    assert [formatting.short(x) for x in (0, 1e-6, 1e-5, 0.1, 3, 1e12)] == [
        "0",
        "1e-6",
        "1e-5",
        "0.1",
        "3",
        "1e+12",
    ]
    # What is shortened is still the same number.
    for base, power in itertools.product((1, 2.5), range(-12, 13)):
        value = base * 10.0**power
        assert float(formatting.short(value)) == pytest.approx(value, rel=1e-12, abs=0)


def test_out_that_is_a_file(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        write_sweep_report(write_sweep(tmp_path / "sweep"), tmp_path / "out")
