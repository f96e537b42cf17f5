"""Reports on synthetic runs on Meta-World: success rates and forward transfer."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.reports.report import to_terminal
from rewire_jax.reports.write import write_report
from tests.fake_run import (
    EDGE,
    LEARNING,
    RATES,
    TRIPLET,
    cells,
    rows,
    write_alone,
    write_cw,
    write_run,
)


def test_success_rates_are_never_normalised(tmp_path: Path) -> None:
    runs = [
        write_cw(tmp_path / "rewire", paper_interactions=1_000_000),
        write_cw(tmp_path / "sac_n", method="sac_n", rates=RATES / 2),
    ]
    report = write_report(runs, tmp_path / "out")
    assert report.title == (
        "continual_world/t3 on Meta-World v3: quick profile, 3 tasks, reduced budget "
        "of 1,000 interactions a task (paper: 1,000,000), reward v2, mujoco backend, "
        "2 seeds"
    )
    assert report.notes == ()
    # Of seed 0 (0.4 + 0.5 + 0.7) / 3, and seed 1 has 0.1 more.
    ours, base = report.numbers.summaries
    end = 1.6 / 3 + EDGE / 2
    assert ours.performance.mean == pytest.approx(end)
    assert base.performance.mean == pytest.approx(0.8 / 3 + EDGE / 2)
    assert ours.forgetting.mean == pytest.approx((-0.4 - 0.4 + 0) / 3)
    assert ours.tasks[1]["end"].mean == pytest.approx(0.55)
    row = cells(report.page, "Ours (rewire)")
    assert row["performance (success rate)"] == "0.58 ± 0.07"
    paper = "paper's Table 2, CW3, average of 8 triplets, Meta-World v1 (success rate)"
    assert row[paper] == "0.67 ± 0.09"
    assert "forward transfer" not in row
    assert "forward_transfer_mean" not in rows(report.folder / "report.csv")[0]
    assert rows(report.folder / "report.csv")[0]["unit"] == "success rate"
    text = " ".join(to_terminal(report).split())
    assert "solved at any of their steps" in text
    assert "Meta-World v1: the tasks" in text
    assert "SAC-N's" not in text
    assert "in returns" not in text


def test_both_rules_of_success_and_the_return_are_always_there(tmp_path: Path) -> None:
    run = write_cw(tmp_path / "run")
    anywhere = write_report([run], tmp_path / "any")
    last = write_report([run], tmp_path / "last", success="last")
    assert last.numbers.summaries[0].performance.mean == pytest.approx(
        anywhere.numbers.summaries[0].performance.mean / 2
    )
    row = cells(last.page, "Ours (rewire)")
    assert row["performance (success rate at the last step)"] == "0.29 ± 0.04"
    names = {"success": 0.95, "success_last": 0.475, "return": 2100}
    for report, mine in ((anywhere, "success"), (last, "success_last")):
        row = rows(report.folder / "tasks.csv")[1]
        assert (row["name"], row["score"]) == (TRIPLET[1], mine)
        (data,) = json.loads((report.folder / "result.json").read_text())["runs"]
        for name, after in names.items():
            prefix = "" if name == mine else f"{name}_"
            assert float(row[f"{prefix}after_mean"]) == pytest.approx(after)
            found = data if name == mine else data["others"][name]
            assert found["tasks"][1]["after"]["mean"] == pytest.approx(after)
            assert np.mean(found["scores"], axis=0)[1, 1] == pytest.approx(after)
        assert set(data["others"]) == set(names) - {mine}
    with pytest.raises(UserError, match="unknown success 'first': choose one of any"):
        write_report([run], tmp_path / "out", success="first")  # type: ignore[arg-type]


def test_forward_transfer_from_single_task_runs(tmp_path: Path) -> None:
    run = write_cw(tmp_path / "run")
    # Reports at 250, 500 and 1000 interactions; the first saw no episode end.
    curves = [[np.nan, 0.1, 0.4], [np.nan, 0.0, 0.0], [np.nan, 0.5, 0.5]]
    single = [
        write_alone(tmp_path / task, task, learning, seeds=2)
        for task, learning in zip(TRIPLET, curves, strict=True)
    ]
    report = write_report([run], tmp_path / "out", single=single)

    def area(learning: np.ndarray, seed: int) -> float:
        return (250 * learning[1] + 500 * learning[2]) / 750 + EDGE * seed

    expected = []
    for seed in (0, 1):
        each = []
        for mine, other in zip(LEARNING, np.array(curves), strict=True):
            alone = (area(other, 0) + area(other, 1)) / 2
            each.append((area(mine, seed) - alone) / (1 - alone))
        expected.append(each)
    (ours,) = report.numbers.summaries
    assert ours.transfer.values == pytest.approx(np.mean(expected, axis=1))
    for task, values in zip(ours.tasks, np.transpose(expected), strict=True):
        assert task["transfer"].values == pytest.approx(values)
    shown = cells(report.page, "Ours (rewire)")["forward transfer"]
    assert shown.startswith(f"{np.mean(expected):.2f} ± ")
    text = report.page.read_text()
    assert f"- {TRIPLET[2]} alone: `{single[2]}`" in text
    assert "(AUC - AUC_b) / (1 - AUC_b)" in text
    data = json.loads((report.folder / "result.json").read_text())
    assert [one["task"] for one in data["single"]] == list(TRIPLET)
    assert float(
        rows(report.folder / "tasks.csv")[1]["transfer_mean"]
    ) == pytest.approx(np.mean(expected, axis=0)[1])
    # By the other rule all rates are halved, so that there is more room above.
    (halved,) = write_report(
        [run], tmp_path / "out", single=single, success="last"
    ).numbers.summaries
    alone = (area(np.array(curves[1]), 0) + EDGE / 2) / 2
    assert halved.tasks[1]["transfer"].values[0] == pytest.approx(
        (area(LEARNING[1], 0) / 2 - alone) / (1 - alone)
    )


def test_forward_transfer_of_what_was_trained(tmp_path: Path) -> None:
    runs = [
        write_cw(tmp_path / "rewire", stages=2),
        write_cw(tmp_path / "ft1", method="ft1", stages=0),
    ]
    always = [np.nan, 1.0, 1.0]
    single = [
        write_alone(tmp_path / task, task, learning, seeds=1)
        for task, learning in zip(TRIPLET, (always, LEARNING[1], always), strict=True)
    ]
    ours, other = write_report(runs, tmp_path / "out", single=single).numbers.summaries
    # Nothing exceeds the first, the third is not trained yet.
    transfer = [task["transfer"].mean for task in ours.tasks]
    alone = (0.4 + 2 * 0.8) / 3
    assert transfer == [None, pytest.approx(EDGE / 2 / (1 - alone)), None]
    assert ours.transfer.mean is None
    assert other.transfer.mean is None


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"reward": "v1"}, r"cannot compare .*odd \(reward v1\)"),
        ({"interactions": 5}, r"cannot compare .*odd \(interactions 5\)"),
        ({"backend": "mjx"}, r"cannot compare .*odd \(backend mjx\)"),
        ({"stages": 0}, "not a finished run of a single task"),
        ({"tasks": TRIPLET, "stages": 3}, "not a finished run of a single task"),
        ({"diverged": (0, 1)}, "not a finished run of a single task"),
        ({"tasks": ("hammer",)}, "two single-task runs of hammer"),
    ],
)
def test_single_task_runs_that_do_not_fit(
    tmp_path: Path, options: dict[str, Any], why: str
) -> None:
    runs = [write_cw(tmp_path / "run")]
    fine = [
        write_alone(tmp_path / task, task, LEARNING[0])
        for task in ("hammer", *TRIPLET[1:])
    ]
    with pytest.raises(UserError, match=f"no single-task run of {TRIPLET[0]}"):
        write_report(runs, tmp_path / "out", single=fine)
    odd = {"scenario": "odd", "tasks": TRIPLET[:1], "stages": 1} | options
    learning = np.tile(LEARNING[:1], (3, 1))
    other = write_cw(tmp_path / "odd", learning=learning, **odd)
    with pytest.raises(UserError, match=why):
        write_report(runs, tmp_path / "out", single=[*fine, other])
    brax = [write_run(tmp_path / "brax")]
    with pytest.raises(UserError, match=r"serve success rates, and .*brax has none"):
        write_report(brax, tmp_path / "out", single=fine)
