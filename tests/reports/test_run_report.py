"""Reports on synthetic run folders with known numbers."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_run import (
    BUDGET,
    EDGE,
    LEARNING,
    RATES,
    SCORES,
    TRIPLET,
    rows,
    write_alone,
    write_cw,
    write_run,
)
from matplotlib.image import imread

from rewire_jax.core.errors import UserError
from rewire_jax.reports.report import Report, to_terminal
from rewire_jax.reports.run_summary import Comparison
from rewire_jax.reports.write import write_report
from rewire_jax.storage.run_results import read_run

METHODS = ("rewire", "ft1", "sac_n")
RAW = "Scores are raw returns, not normalised: there is no SAC-N run among them"


def cells(report: Report[Comparison], label: str) -> dict[str, str]:
    """A run's row of the first table of the Markdown, by heading."""
    table = report.page.read_text().split("\n\n| ")[1].splitlines()
    split = [line.strip("| ").split(" | ") for line in table]
    (found,) = [row for row in split if row[0] == label]
    return dict(zip(split[0], found, strict=True))


def test_known_numbers_everywhere(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", paper_interactions=1_000_000)
    report = write_report([run], tmp_path / "new" / "out")

    # Means over the seeds are 100 above seed 0; two values 200 apart: std 141.42.
    text = report.page.read_text()
    assert (
        "| Ours (rewire) | 1 hugefoot | 101 ± 141 | 1,100 ± 141 | 500 ± 141 | -600 ± 0 "
    ) in text
    assert "| 3 carry_stuff | 103 ± 141 | 3,100 ± 141 | 3,100 ± 141 | 0.00" in text
    end = (400 + 1500 + 3000) / 3 + 100
    row = cells(report, "Ours (rewire)")
    assert row["performance (raw return)"] == f"{end:,.0f} ± 141"
    # Of 400, 600, 1500, 1700, 3000, 3200 the middle four.
    assert row["IQM [95% interval]"].startswith("1,700 [")
    assert row["forgetting"] == "-367 ± 0"
    assert row["forward transfer"] == "–"
    assert (row["model size"], row["training"], row["selection"]) == (
        "2.25",
        "3,000",
        "77",
    )
    # Three tasks of 63 s.
    assert row["hours, all seeds together"] == "0.05"
    assert (row["seeds"], row["device"]) == ("2", "cpu")
    assert "abc123" in text
    assert all(path.name in text for path in report.paths if path.suffix == ".png")

    tasks = rows(report.folder / "tasks.csv")
    assert [row["name"] for row in tasks] == ["hugefoot", "moon", "carry_stuff"]
    assert float(tasks[1]["after_mean"]) == 2100
    assert float(tasks[1]["after_std"]) == pytest.approx(200 / 2**0.5)
    assert float(tasks[1]["forgetting_mean"]) == -500
    (row,) = rows(report.folder / "report.csv")
    assert row["unit"] == "raw return"
    assert float(row["performance_mean"]) == pytest.approx(end)
    assert row["forward_transfer_mean"] == ""
    assert float(row["iqm_low"]) <= 1700 <= float(row["iqm_high"])
    # Chunks of 250 and 500 interactions in 1 s and 2 s; the first ones compiled.
    assert float(row["interactions_per_second"]) == 2 * 750 / 3

    (data,) = json.loads((report.folder / "result.json").read_text())["runs"]
    assert data["tasks"][0]["end"]["values"] == [400, 600]
    assert data["scores"][1][2] == [600, 1700, 3200]
    assert data["mean_forgetting"]["mean"] == pytest.approx(-1100 / 3)
    assert data["provenance"]["commit"] == "abc123"
    assert (data["complete"], data["kept"], data["budget"]) == (True, [0, 1], BUDGET)
    (note,) = report.notes
    assert note.startswith(RAW)


def test_stored_states_have_a_column_only_where_there_are_some(tmp_path: Path) -> None:
    bare = write_run(tmp_path / "bare", method="ft1")
    storing = write_run(tmp_path / "storing", method="clonex", stored=1.2)
    report = write_report([bare, storing], tmp_path / "both")
    for label, method, stored in (("FT-1", "ft1", 0.0), ("clonex", "clonex", 3.6)):
        row = cells(report, label)
        assert (row["model size"], row["stored states"]) == ("2.25", f"{stored:.2f}")
        of = {row["method"]: row for row in rows(report.folder / "report.csv")}
        assert float(of[label]["stored_states"]) == pytest.approx(stored)
        found = json.loads((report.folder / "result.json").read_text())["runs"]
        (run,) = [run for run in found if run["method"] == method]
        assert run["stored_states"] == pytest.approx(stored)
    alone = write_report([bare], tmp_path / "alone")
    assert "stored states" not in cells(alone, "FT-1")
    assert "stored_states" not in rows(alone.folder / "report.csv")[0]


def test_sac_n_normalises(tmp_path: Path) -> None:
    # Seeds of a run are 200 apart: the base's average at the end is 1900 + 100.
    ends = np.array([900.0, 1800, 3000])
    base = np.array([[0, 0, 0], [1000, 0, 0], [1000, 1900, 0], ends])
    runs = [
        write_run(tmp_path / "rewire"),
        write_run(tmp_path / "sac_n", method="sac_n", scores=base, size=7.25),
    ]
    report = write_report(runs, tmp_path / "out")
    assert report.notes == ()
    ours, theirs = report.numbers.summaries
    assert theirs.performance.mean == pytest.approx(1)
    assert theirs.performance.std == pytest.approx(200 / 2**0.5 / 2000)
    assert theirs.transfer.mean == pytest.approx(0)
    assert theirs.forgetting.mean == pytest.approx(-200 / 3 / 2000)
    assert ours.performance.mean == pytest.approx((4900 / 3 + 100) / 2000)
    assert ours.iqm.value == pytest.approx(1700 / 2000)
    assert ours.forgetting.mean == pytest.approx(-1100 / 3 / 2000)
    # Right after own training 1000, 2000, 3000 against 1000, 1900, 3000.
    assert ours.transfer.mean == pytest.approx(100 / 3 / 2000)
    # Returns of single tasks stay returns.
    assert ours.tasks[0]["end"].mean == 500
    row = cells(report, "Ours (rewire)")
    assert row["performance (÷ SAC-N)"] == "0.87 ± 0.07"
    assert row["paper's Table 1, HalfCheetah (4 scenarios) (÷ SAC-N)"] == "1.17 ± 0.15"
    assert row["its model size"] == "2.1"
    assert row["paper's Table 3, this scenario (÷ SAC-N)"] == "1.31 ± 0.21"
    row = cells(report, "SAC-N")
    assert row["model size"] == "8.00"
    assert row["paper's Table 3, this scenario (÷ SAC-N)"] == "–"
    assert rows(report.folder / "report.csv")[0]["paper_table_3_mean"] == "1.31"


def test_partial_runs_are_normalised_by_sac_n_at_their_stage(tmp_path: Path) -> None:
    scores = SCORES * [[1], [1], [1], [2]]
    runs = [
        write_run(tmp_path / "rewire", stages=2),
        write_run(tmp_path / "sac_n", method="sac_n", scores=scores),
    ]
    ours, theirs = write_report(runs, tmp_path / "out").numbers.summaries
    # After two tasks both have 700 and 2000; only SAC-N goes on.
    assert ours.performance.mean == pytest.approx(1)
    assert theirs.performance.mean == pytest.approx(1)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"stages": 2}, "SAC-N has finished fewer tasks than another run"),
        ({"scores": -SCORES}, "SAC-N's average return is not above 0"),
        ({"diverged": (0, 1)}, "all seeds of SAC-N diverged"),
    ],
)
def test_sac_n_that_cannot_normalise(
    tmp_path: Path, options: dict[str, Any], why: str
) -> None:
    runs = [
        write_run(tmp_path / "rewire"),
        write_run(tmp_path / "sac_n", method="sac_n", **options),
    ]
    report = write_report(runs, tmp_path / "out")
    assert report.notes[0] == f"Scores are raw returns, not normalised: {why}."
    assert report.numbers.summaries[0].performance.mean == pytest.approx(4900 / 3 + 100)
    assert "performance (raw return)" in cells(report, "SAC-N")


def test_single_task(tmp_path: Path) -> None:
    options: dict[str, Any] = {"stages": 1, "tasks": ("hugefoot",)}
    runs = [
        write_run(tmp_path / name, method=name, **options)
        for name in ("rewire", "sac_n")
    ]
    ours, theirs = write_report(runs, tmp_path / "out").numbers.summaries
    assert ours.forgetting.mean == 0
    assert ours.transfer.mean == pytest.approx(0)
    assert ours.performance == theirs.performance


@pytest.mark.parametrize(
    ("settings", "ending"),
    [
        ({}, "2 seeds, reduced budget"),
        ({"profile": "paper"}, "2 seeds"),
        (
            {"profile": "paper", "paper_interactions": 2000},
            "2 seeds, reduced budget (paper: 2,000)",
        ),
        ({"paper_interactions": 1000}, "2 seeds"),
    ],
)
def test_title_names_the_budget(
    tmp_path: Path, settings: dict[str, Any], ending: str
) -> None:
    title = write_report([write_run(tmp_path / "run", **settings)], tmp_path).title
    assert title == (
        f"halfcheetah/forgetting: {settings.get('profile', 'quick')} profile, "
        f"3 of 8 tasks, 1,000 interactions a task, positional backend, {ending}"
    )


def test_terminal_fits_its_width(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, method=name) for name in METHODS]
    report = write_report(runs, tmp_path / "out")
    text = to_terminal(report)
    tables = [line for line in text.splitlines() if str(tmp_path) not in line]
    assert max(map(len, tables)) <= 100
    assert "3,100 ± 141" in text
    assert "…" not in text
    assert "\x1b" not in text
    assert str(report.folder / "curves.png") in text


def test_pictures_are_not_blank(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, method=name) for name in ("rewire", "ft1")]
    report = write_report(runs, tmp_path / "out")
    for path in (
        report.folder / "curves.png",
        report.folder / "matrix.png",
        report.folder / "tradeoff.png",
    ):
        image = imread(path)
        assert min(image.shape[:2]) > 400
        assert len(np.unique(image.reshape(-1, image.shape[2]), axis=0)) > 100
        assert 0.005 < (image[..., :3].min(axis=2) < 0.9).mean() < 0.9


@pytest.mark.parametrize("name", ["settings.json", "results.jsonl", "timing.jsonl"])
def test_missing_file_is_named(tmp_path: Path, name: str) -> None:
    run = write_run(tmp_path / "run")
    (run / name).unlink()
    with pytest.raises(UserError, match=name) as error:
        write_report([run], tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_diverged_seed_is_left_out(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", seeds=3, diverged=(1,))
    report = write_report([run], tmp_path / "out")
    note = report.notes[-1]
    assert note.startswith("Ours (rewire): 1 diverged seed left out")
    (data,) = json.loads((report.folder / "result.json").read_text())["runs"]
    assert data["kept"] == [0, 2]
    assert data["tasks"][0]["end"]["values"] == [400, 800]
    assert cells(report, "Ours (rewire)")["seeds"] == "2 of 3"


def test_all_seeds_diverged(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", diverged=(0, 1))
    report = write_report([run], tmp_path / "out")
    assert "| Ours (rewire) | 1 hugefoot | – | – | – | – |" in report.page.read_text()
    assert "pictures: 0, 1." in to_terminal(report).replace("\n", " ")


def test_partial_run_says_so(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", stages=2)
    report = write_report([run], tmp_path / "out")
    note = report.notes[-1]
    assert note.startswith("Ours (rewire): unfinished, 2 of 3 tasks")
    text = report.page.read_text()
    assert "| 1 hugefoot | 101 ± 141 | 1,100 ± 141 | 800 ± 141 | -300 ± 0 |" in text
    assert "| 3 carry_stuff | 103 ± 141 | – | – | – |" in text
    # Over the two trained tasks: (700 + 2000) / 2 + 100.
    assert report.numbers.summaries[0].performance.mean == 1450


def test_run_before_training(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", stages=0)
    (run / "training.jsonl").unlink()
    (run / "timing.jsonl").unlink()
    report = write_report([run], tmp_path / "out")
    assert "no results after training yet" in report.notes[-1]
    assert "| 1 hugefoot | 101 ± 141 | – | – | – |" in report.page.read_text()
    (run / "results.jsonl").write_text("")
    with pytest.raises(UserError, match="holds no results yet"):
        read_run(run)


def test_runs_of_one_method_are_told_apart(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name) for name in ("a", "b")]
    report = write_report(runs, tmp_path / "out")
    assert [s.label for s in report.numbers.summaries] == [
        "Ours (rewire): a",
        "Ours (rewire): b",
    ]
    # The paper's figures are not those of any variant.
    assert "1.17" not in report.page.read_text()
    with pytest.raises(UserError, match="given twice"):
        write_report([runs[0], runs[0]], tmp_path / "out")


@pytest.mark.parametrize(
    "other",
    [
        {"backend": "spring"},
        {"interactions": 5},
        {"profile": "paper"},
        {"reward": "v1"},
        # Only this one knows success.
        {"rates": np.zeros((4, 3))},
    ],
)
def test_incomparable_runs_are_refused(tmp_path: Path, other: dict[str, Any]) -> None:
    runs = [
        write_run(tmp_path / "a"),
        write_run(tmp_path / "b", method="ft1", **other),
    ]
    with pytest.raises(UserError, match="cannot compare"):
        write_report(runs, tmp_path / "out")


def test_one_seed_shows_no_spread(tmp_path: Path) -> None:
    report = write_report([write_run(tmp_path / "run", seeds=1)], tmp_path / "out")
    text = report.page.read_text()
    assert "1 hugefoot | 1.00 | 1,000 | 400 | -600 |" in text
    assert "1 seed," in report.title
    # Of three values none is cut.
    assert cells(report, "Ours (rewire)")["IQM [95% interval]"] == "1,633"


def test_out_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        write_report([write_run(tmp_path / "run")], tmp_path / "out")


def test_success_rates_are_never_normalised(tmp_path: Path) -> None:
    runs = [
        write_cw(tmp_path / "rewire", paper_interactions=1_000_000),
        write_cw(tmp_path / "sac_n", method="sac_n", rates=RATES / 2),
    ]
    report = write_report(runs, tmp_path / "out")
    assert report.title == (
        "continual_world/t3 on Meta-World v3: quick profile, 3 tasks, 1,000 "
        "interactions a task, reward v2, mujoco backend, 2 seeds, reduced budget "
        "(paper: 1,000,000)"
    )
    assert report.notes == ()
    # Of seed 0 (0.4 + 0.5 + 0.7) / 3, and seed 1 has 0.1 more.
    ours, base = report.numbers.summaries
    end = 1.6 / 3 + EDGE / 2
    assert ours.performance.mean == pytest.approx(end)
    assert base.performance.mean == pytest.approx(0.8 / 3 + EDGE / 2)
    assert ours.forgetting.mean == pytest.approx((-0.4 - 0.4 + 0) / 3)
    assert ours.tasks[1]["end"].mean == pytest.approx(0.55)
    row = cells(report, "Ours (rewire)")
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
    row = cells(last, "Ours (rewire)")
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
    shown = cells(report, "Ours (rewire)")["forward transfer"]
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
