"""Reports on synthetic run folders with known numbers."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_run import BUDGET, write_run
from matplotlib.image import imread

from rewire_jax.errors import UserError
from rewire_jax.report import read_run, to_terminal, write_report


def cell(rows: list[dict[str, str]], measure: str, task: str = "") -> dict[str, str]:
    found = [r for r in rows if r["measure"] == measure and r["task"] == task]
    assert len(found) == 1
    return found[0]


def test_known_numbers_everywhere(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", paper_interactions=1_000_000)
    report = write_report([run], tmp_path / "new" / "out")

    # Means over the seeds are 100 above seed 0; two values 200 apart: std 141.42.
    text = report.markdown.read_text()
    assert (
        "| rewire | 1 hugefoot | 101 ± 141 | 1,100 ± 141 | 500 ± 141 | -600 ± 0 |"
    ) in text
    assert "| rewire | 3 carry_stuff | 103 ± 141 | 3,100 ± 141 | 3,100 ± 141 | 0.00"
    end = (400 + 1500 + 3000) / 3 + 100
    assert f"| rewire | 2 | {end:,.0f} ± 141 | -367 ± 0 | 2.25 | 3,000 | 77 |" in text
    assert "abc123" in text
    assert "curves.png" in text

    with report.csv.open() as file:
        rows = list(csv.DictReader(file))
    assert float(cell(rows, "after", "1")["mean"]) == 2100
    assert float(cell(rows, "after", "1")["std"]) == pytest.approx(200 / 2**0.5)
    assert float(cell(rows, "forgetting", "1")["mean"]) == -500
    assert float(cell(rows, "performance")["mean"]) == pytest.approx(end)
    # Chunks of 250 and 500 interactions in 1 s and 2 s; the first ones compiled.
    assert float(cell(rows, "interactions_per_second")["mean"]) == 2 * 750 / 3

    (data,) = json.loads(report.json.read_text())["runs"]
    assert data["tasks"][0]["end"]["values"] == [400, 600]
    assert data["mean_forgetting"]["mean"] == pytest.approx(-1100 / 3)
    assert data["provenance"]["commit"] == "abc123"
    assert (data["complete"], data["seeds"], data["budget"]) == (True, [0, 1], BUDGET)
    assert report.notes == ()


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
        f"1,000 interactions a task, positional backend, {ending}"
    )


def test_terminal_fits_its_width(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, method=name) for name in ("rewire", "ft1")]
    report = write_report(runs, tmp_path / "out")
    text = to_terminal(report)
    tables = [line for line in text.splitlines() if str(tmp_path) not in line]
    assert max(map(len, tables)) <= 100
    assert "3,100 ± 141" in text
    assert "…" not in text
    assert "\x1b" not in text
    assert str(report.curves) in text


def test_pictures_are_not_blank(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, method=name) for name in ("rewire", "ft1")]
    report = write_report(runs, tmp_path / "out")
    for path in (report.curves, report.matrix):
        image = imread(path)
        assert min(image.shape[:2]) > 400
        assert len(np.unique(image.reshape(-1, image.shape[2]), axis=0)) > 100
        assert 0.005 < (image[..., :3].min(axis=2) < 0.9).mean() < 0.9


@pytest.mark.parametrize("name", ["settings.json", "results.jsonl", "timing.jsonl"])
def test_missing_file_is_named(tmp_path: Path, name: str) -> None:
    run = write_run(tmp_path / "run")
    (run / name).unlink()
    with pytest.raises(UserError, match=f"{name} is missing") as error:
        write_report([run], tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_diverged_seed_is_left_out(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", seeds=3, diverged=(1,))
    report = write_report([run], tmp_path / "out")
    (note,) = report.notes
    assert note.startswith("rewire: seed 1 diverged")
    (data,) = json.loads(report.json.read_text())["runs"]
    assert data["kept"] == [0, 2]
    assert data["tasks"][0]["end"]["values"] == [400, 800]
    assert "| rewire | 2 of 3 |" in report.markdown.read_text()


def test_all_seeds_diverged(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", diverged=(0, 1))
    report = write_report([run], tmp_path / "out")
    assert "| rewire | 1 hugefoot | – | – | – | – |" in report.markdown.read_text()
    assert "seeds 0, 1 diverged" in to_terminal(report).replace("\n", " ")


def test_partial_run_says_so(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", stages=2)
    report = write_report([run], tmp_path / "out")
    (note,) = report.notes
    assert note.startswith("rewire: unfinished, 2 of 3 tasks")
    text = report.markdown.read_text()
    assert "| 1 hugefoot | 101 ± 141 | 1,100 ± 141 | 800 ± 141 | -300 ± 0 |" in text
    assert "| 3 carry_stuff | 103 ± 141 | – | – | – |" in text
    # Over the two trained tasks: (700 + 2000) / 2 + 100.
    assert report.summaries[0].performance.mean == 1450


def test_run_before_training(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", stages=0)
    (run / "training.jsonl").unlink()
    (run / "timing.jsonl").unlink()
    report = write_report([run], tmp_path / "out")
    assert "no results after training yet" in report.notes[0]
    assert "| 1 hugefoot | 101 ± 141 | – | – | – |" in report.markdown.read_text()
    (run / "results.jsonl").write_text("")
    with pytest.raises(UserError, match="holds no results yet"):
        read_run(run)


def test_runs_of_one_method_are_told_apart(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name) for name in ("a", "b")]
    report = write_report(runs, tmp_path / "out")
    assert [s.label for s in report.summaries] == ["rewire (a)", "rewire (b)"]
    with pytest.raises(UserError, match="given twice"):
        write_report([runs[0], runs[0]], tmp_path / "out")


@pytest.mark.parametrize(
    "other", [{"backend": "spring"}, {"interactions": 5}, {"profile": "paper"}]
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
    text = report.markdown.read_text()
    assert "1 hugefoot | 1.00 | 1,000 | 400 | -600 |" in text
    assert "1 seed," in report.title


def test_out_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        write_report([write_run(tmp_path / "run")], tmp_path / "out")
