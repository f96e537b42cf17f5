"""Reports on synthetic run folders with known numbers."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from rewire_jax.core.errors import UserError
from rewire_jax.reports.report import to_terminal
from rewire_jax.reports.write import write_report
from rewire_jax.storage.run_results import read_run
from tests.fake_run import BUDGET, SCORES, cells, rows, write_run

METHODS = ("rewire", "ft1", "sac_n")
RAW = "Scores are raw returns, not normalised: there is no SAC-N run among them"


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
    row = cells(report.page, "Ours (rewire)")
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
    for label, method, stored in (("FT-1", "ft1", 0.0), ("ClonEx-SAC", "clonex", 3.6)):
        row = cells(report.page, label)
        assert (row["model size"], row["stored states"]) == ("2.25", f"{stored:.2f}")
        of = {row["method"]: row for row in rows(report.folder / "report.csv")}
        assert float(of[label]["stored_states"]) == pytest.approx(stored)
        found = json.loads((report.folder / "result.json").read_text())["runs"]
        (run,) = [run for run in found if run["method"] == method]
        assert run["stored_states"] == pytest.approx(stored)
    alone = write_report([bare], tmp_path / "alone")
    assert "stored states" not in cells(alone.page, "FT-1")
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
    row = cells(report.page, "Ours (rewire)")
    assert row["performance (÷ SAC-N)"] == "0.87 ± 0.07"
    assert row["paper's Table 1, HalfCheetah (4 scenarios) (÷ SAC-N)"] == "1.17 ± 0.15"
    assert row["model size in the paper"] == "2.1"
    assert row["paper's Table 3, this scenario (÷ SAC-N)"] == "1.31 ± 0.21"
    row = cells(report.page, "SAC-N")
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
    assert "performance (raw return)" in cells(report.page, "SAC-N")


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
    ("settings", "before", "after"),
    [
        ({}, "reduced budget of ", ""),
        ({"profile": "paper"}, "", ""),
        (
            {"profile": "paper", "paper_interactions": 2000},
            "reduced budget of ",
            " (paper: 2,000)",
        ),
        ({"paper_interactions": 1000}, "", ""),
    ],
)
def test_title_names_the_budget(
    tmp_path: Path, settings: dict[str, Any], before: str, after: str
) -> None:
    title = write_report([write_run(tmp_path / "run", **settings)], tmp_path).title
    assert title == (
        f"halfcheetah/forgetting: {settings.get('profile', 'quick')} profile, "
        f"3 of 8 tasks, {before}1,000 interactions a task{after}, "
        "positional backend, 2 seeds"
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
    for name in report.pictures:
        image = imread(report.folder / name)
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
    assert cells(report.page, "Ours (rewire)")["seeds"] == "2 of 3"


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
    assert report.title.endswith(" 1 seed")
    # Of three values none is cut.
    assert cells(report.page, "Ours (rewire)")["IQM [95% interval]"] == "1,633"


def test_a_name_with_dollars_is_no_formula(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name) for name in (r"$\foo$", "$_{$")]
    report = write_report(runs, tmp_path / "out")
    assert all((report.folder / name).exists() for name in report.pictures)


def test_out_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        write_report([write_run(tmp_path / "run")], tmp_path / "out")
