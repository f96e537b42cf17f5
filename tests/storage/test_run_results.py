"""Run folders as crashes, resumed runs and damage leave them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_run import replace_line, write_run

from rewire_jax.core.errors import UserError
from rewire_jax.storage.run_results import read_progress, read_run


def test_cut_last_lines_are_ignored(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    whole = read_run(run)
    for name in ("results", "training", "timing"):
        with (run / f"{name}.jsonl").open("ab") as file:
            file.write('{"stage": 2, "return": 1 "é'.encode()[:-1])
    cut = read_run(run)
    np.testing.assert_array_equal(cut.scores, whole.scores)
    assert cut.rate == whole.rate
    assert cut.complete


@pytest.mark.parametrize("name", ["results", "training", "timing"])
@pytest.mark.parametrize(
    "text", ['{"stage": 0, "ta', "7", '{"stage": 9, "task": 0}', "{}", ""]
)
def test_damaged_line_is_named(tmp_path: Path, name: str, text: str) -> None:
    path = write_run(tmp_path / "run") / f"{name}.jsonl"
    replace_line(path, 4, text)
    with pytest.raises(UserError, match=f"{name}.jsonl, line 4 is damaged") as error:
        read_run(path.parent)
    assert "\n" not in str(error.value)


def test_damaged_settings(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run") / "settings.json"
    path.write_text(path.read_text().replace("backend", "back"))
    with pytest.raises(UserError, match=r"settings\.json is damaged .*'backend'"):
        read_run(path.parent)
    path.write_text(path.read_text()[:50])
    with pytest.raises(UserError, match=r"settings\.json is damaged"):
        read_run(path.parent)


def test_half_written_stage_does_not_count(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    path = run / "results.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    assert read_run(run).finished == 2


@pytest.mark.parametrize("name", ["results", "training", "timing"])
def test_a_row_that_is_there_twice_is_named(tmp_path: Path, name: str) -> None:
    path = write_run(tmp_path / "run") / f"{name}.jsonl"
    lines = path.read_text().splitlines()
    replace_line(path, 3, lines[1])
    with pytest.raises(UserError, match=f"{name}.jsonl, line 3 is damaged .*line 2"):
        read_run(path.parent)


WRONG: dict[str, list[tuple[str, Any]]] = {
    "results": [
        ("stage", True),
        ("stage", 0.0),
        ("task", 1),  # whose name is another
        ("name", "moon"),
        ("name", 7),
        ("seed", 1),
        ("member", 1),
        ("member", "0"),
        ("episodes", 0),
        ("interactions", {"training": -1, "selection": 0}),
        ("interactions", {"training": 0}),
        ("interactions", 7),
        ("diverged", 0),
        ("model_size", "1"),
        ("model_size", float("nan")),
        ("stored_states", -1.0),
        ("return", None),  # of a member that did not diverge
        ("return", float("nan")),
        ("return", float("inf")),
        ("return", "1"),
        ("return", True),
        ("success", 1.5),
    ],
    "training": [
        ("stage", -1),
        ("seed", 9),
        ("interactions", -1),
        ("interactions", 0.5),
        ("reward", float("inf")),
        ("critic_loss", "small"),
        ("success_last", -0.1),
    ],
    "timing": [
        ("stage", 3),
        ("seconds", -1.0),
        ("seconds", float("nan")),
        ("compile", 1),
        ("polishing", -1),
        ("memory", {"process": -1}),
        ("memory", {"device": 0.5}),
    ],
}


@pytest.mark.parametrize(
    ("name", "field", "value"),
    [(name, *wrong) for name, fields in WRONG.items() for wrong in fields],
)
def test_a_field_that_cannot_be_is_named(
    tmp_path: Path, name: str, field: str, value: Any
) -> None:
    path = write_run(tmp_path / "run") / f"{name}.jsonl"
    row = json.loads(path.read_text().splitlines()[0]) | {field: value}
    replace_line(path, 1, json.dumps(row))
    with pytest.raises(UserError, match=f"{name}.jsonl, line 1 .*{field}") as error:
        read_run(path.parent)
    assert "\n" not in str(error.value)


def test_a_diverged_seed_may_have_no_return(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run") / "results.jsonl"
    row = json.loads(path.read_text().splitlines()[0])
    replace_line(path, 1, json.dumps(row | {"return": None, "diverged": True}))
    assert read_run(path.parent).diverged == (0,)


def test_updates_after_the_last_interaction_count_in_hours_but_not_in_the_rate(
    tmp_path: Path,
) -> None:
    run = write_run(tmp_path / "run")
    # Three tasks of 60 s while compiling, then 1 s and 2 s for 750 interactions.
    data = read_run(run)
    assert data.hours == pytest.approx(3 * 63 / 3600)
    assert data.rate == pytest.approx(2 * 3 * 750 / 9)
    with (run / "timing.jsonl").open("a") as file:
        for polishing, seconds in ((10, 4), (20, 5)):
            file.write(
                f'{{"stage": 2, "interactions": 1000, "polishing": {polishing}, '
                f'"seconds": {seconds}, "compile": false}}\n'
            )
    data = read_run(run)
    assert data.hours == pytest.approx((3 * 63 + 9) / 3600)
    assert data.rate == pytest.approx(2 * 3 * 750 / 9)


def test_most_memory_is_over_all_processes_of_a_run_and_the_device_s_if_known(
    tmp_path: Path,
) -> None:
    run = write_run(tmp_path / "run")
    assert read_run(run).memory == {}  # an older run

    def report(polishing: int, **memory: int) -> None:
        row = {"stage": 2, "interactions": 1000, "polishing": polishing}
        row |= {"seconds": 1, "compile": False, "memory": memory}
        with (run / "timing.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")

    report(1, process=700)
    report(2, process=500)
    assert read_run(run).memory == {"process": 700}
    run = write_run(tmp_path / "other")
    report(1, process=700, device=400)
    report(2, process=900, device=300)
    assert read_run(run).memory == {"device": 400}


def test_any_value_of_the_progress_reports_can_be_read(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "run"))
    read = read_progress(run, "reward")
    for (x, values), (same, returns) in zip(read, run.curve, strict=True):
        np.testing.assert_array_equal(x, same)
        np.testing.assert_allclose(values * run.episode_length, returns)
    with pytest.raises(UserError, match="no 'fame'"):
        read_progress(run, "fame")
