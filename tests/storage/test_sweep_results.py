"""Folders of sweeps as crashes, halving and damage leave them."""

import json

import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.storage.sweep_results import read_batches, read_sweep
from tests.fake_run import replace_line, write_run
from tests.fake_sweep import GRID, TASKS, choice, score, write_sweep

PART = GRID[:3]


def test_everything_is_where_it_belongs(tmp_path):
    data = read_sweep(write_sweep(tmp_path / "sweep", configurations=PART, size=4))
    assert data.axes == {
        name: pytest.approx([c[name] for c in PART for _ in range(2)])
        for name in ("modes", "alpha", "beta")
    }
    assert data.configurations.tolist() == [0, 0, 1, 1, 2, 2]
    assert data.seeds.tolist() == [0, 1] * 3
    assert data.tasks == TASKS
    for m, s, t in np.ndindex(6, 3, 3):
        member = {"values": PART[m // 2], "seed": m % 2}
        assert data.scores[m, s, t] == score(member, s, t)
        assert data.choice[m, s, t] == choice(member, s, t)
        assert data.model_size[m, s] == pytest.approx(1.75 + 0.25 * s + m / 100)
        assert data.training[m, s] == 1000 * (s + 1)
        assert data.selection[m, s] == 7 * (s + 1) + m
    assert data.trained.all()
    assert data.evaluated.all()
    assert not data.diverged.any()
    assert not data.stopped.any()
    assert data.complete
    # Two batches a task, 36 s each.
    assert data.hours == pytest.approx(3 * 2 * 36 / 3600)


def test_as_far_as_it_has_come(tmp_path):
    folder = write_sweep(tmp_path / "sweep", configurations=PART, stages=2, size=4)
    assert read_sweep(folder).finished == 2
    assert not read_sweep(folder).complete
    # The second batch has yet to begin the second task.
    (folder / "task-001" / "batch-001" / "results.jsonl").unlink()
    (folder / "task-001" / "batch-001" / "timing.jsonl").unlink()
    data = read_sweep(folder)
    assert data.finished == 1
    assert data.reached.tolist() == [2, 2, 2, 2, 1, 1]
    assert not data.stopped.any()
    assert np.isnan(data.scores[4:, 1]).all()
    # A row of a task is missing: its member is not through.
    path = folder / "task-001" / "batch-000" / "results.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    assert read_sweep(folder).reached.tolist() == [2, 2, 2, 1, 1, 1]
    (folder / "task-001" / "batches.json").unlink()
    assert read_sweep(folder).finished == 1
    (folder / "task-000" / "batches.json").unlink()
    with pytest.raises(UserError, match="no results after training yet"):
        read_sweep(folder)


def test_before_training_there_is_nothing(tmp_path):
    folder = write_sweep(tmp_path / "sweep", configurations=PART, stages=1, size=6)
    path = folder / "task-000" / "batch-000" / "results.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if json.loads(line)["stage"] < 0))
    with pytest.raises(UserError, match="no results after training yet"):
        read_sweep(folder)


def test_halved_away_is_not_unfinished(tmp_path):
    folder = write_sweep(tmp_path / "s", configurations=PART, going_on=[(0, 2), (2,)])
    data = read_sweep(folder)
    assert data.complete
    assert data.reached.tolist() == [2, 2, 1, 1, 3, 3]
    expected = np.zeros((6, 3), bool)
    expected[2:4, 0] = expected[:2, 1] = True
    np.testing.assert_array_equal(data.stopped, expected)
    # The next task has not begun: nobody is known to have stopped.
    (folder / "task-002" / "batches.json").unlink()
    expected[:2, 1] = False
    np.testing.assert_array_equal(read_sweep(folder).stopped, expected)


def test_diverged_once_is_diverged_for_good(tmp_path):
    folder = write_sweep(tmp_path / "s", configurations=PART, diverged={3: 1, 0: 2})
    path = folder / "task-002" / "batch-000" / "results.jsonl"
    text = path.read_text().replace('"diverged": true', '"diverged": false')
    path.write_text(text.replace("null", "1.0"))
    data = read_sweep(folder)
    assert data.diverged[3].tolist() == [False, True, True]
    assert np.isnan(data.scores[3, 1]).all()
    assert data.complete


def test_a_cut_last_line_is_ignored(tmp_path):
    folder = write_sweep(tmp_path / "sweep", configurations=PART)
    whole = read_sweep(folder)
    path = folder / "task-001" / "batch-000" / "results.jsonl"
    with path.open("ab") as file:
        file.write(b'{"stage": 1, "return": 1 "\xc3')
    np.testing.assert_array_equal(read_sweep(folder).scores, whole.scores)


@pytest.mark.parametrize(
    ("batch", "values"),
    [
        (0, {"member": 6}),  # there is none
        (0, {"member": 5}),  # it is in the other batch
        (0, {"seed": 1}),
        (0, {"stage": 2}),  # in the folder of stage 1
        (1, {"choice": None}),
    ],
)
def test_a_row_of_another_place_is_refused(tmp_path, batch, values):
    folder = write_sweep(tmp_path / "sweep", configurations=PART)
    path = folder / "task-001" / f"batch-00{batch}" / "results.jsonl"
    row = json.loads(path.read_text().splitlines()[0]) | values
    replace_line(path, 1, json.dumps(row))
    with pytest.raises(UserError, match=r"results\.jsonl, line 1 is damaged"):
        read_sweep(folder)


@pytest.mark.parametrize(
    "text",
    ['{"stage": 0, "ta', "{}", '{"stage": 1, "task": 0, "member": 6}', ""],
)
def test_damaged_line_is_named(tmp_path, text):
    folder = write_sweep(tmp_path / "sweep", configurations=PART)
    path = folder / "task-001" / "batch-001" / "results.jsonl"
    replace_line(path, 2, text)
    with pytest.raises(UserError, match=r"results\.jsonl, line 2 is damaged") as error:
        read_sweep(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ('"seed": 1', '"sed": 1', "no 'seed'"),
        ('"member": 3', '"member": 5', "members are not in order"),
        ('"alpha": 0.0}', '"alpha": "x"}', "could not convert"),
        ('"values": {"modes"', '"values": {"mode"', "no 'modes'"),
        ('"halving": 1', '"halving": null', "halving is None"),
    ],
)
def test_damaged_header_is_named(tmp_path, old, new, why):
    folder = write_sweep(
        tmp_path / "s", configurations=[{"modes": 1, "alpha": 0.0}] * 2, stages=0
    )
    path = folder / "settings.json"
    # The last of them, which is a member's.
    before, found, after = path.read_text().rpartition(old)
    assert found
    path.write_text(before + new + after)
    with pytest.raises(UserError, match=rf"settings\.json is damaged .*{why}"):
        read_sweep(folder)


@pytest.mark.parametrize("text", ['{"batches": [[0, 6]]}', "[]", '{"batches": [['])
def test_damaged_batches_are_named(tmp_path, text):
    folder = write_sweep(tmp_path / "sweep", configurations=PART)
    (folder / "task-001" / "batches.json").write_text(text)
    with pytest.raises(UserError, match=r"task-001/batches\.json is damaged"):
        read_sweep(folder)


def test_other_folders_are_told_apart(tmp_path):
    run = write_run(tmp_path / "run")
    with pytest.raises(UserError, match="holds a run"):
        read_sweep(run)
    with pytest.raises(UserError, match=r"no settings\.json"):
        read_sweep(tmp_path)


@pytest.mark.parametrize(
    "content",
    [
        {"size": 2, "batches": [[0, 1], [0, 1]]},
        {"size": 0, "batches": []},
        {"size": -1, "batches": [[0]]},
        {"size": 1, "batches": [[0, 1]]},
        {"size": 2, "batches": [[0.5, 1]]},
        {"size": 2.0, "batches": [[0, 1]]},
        {"size": 2, "batches": [[True, 0]]},
    ],
)
def test_batches_that_cannot_be_are_refused(tmp_path, content):
    path = tmp_path / "batches.json"
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=str(path)):
        read_batches(path)
