"""Delays and false alarms from hand-made rows of segments."""

import json
from pathlib import Path

import numpy as np

from rewire_jax.reports import noticed_changes, run_report
from rewire_jax.reports.run_summary import summarize
from rewire_jax.storage.run_results import read_run
from tests.fake_run import write_run

# Of two seeds, after each of the three reports in a task.
SEGMENTS = {
    0: [[0, 0, 0], [1, 1, 2], [2, 2, 2]],
    1: [[0, 1, 1], [1, 1, 1], [1, 2, 4]],
}


def write(folder: Path, diverged: tuple[int, ...] = ()) -> Path:
    folder = write_run(folder, method="ft_n", boundaries="detected", diverged=diverged)
    path = folder / "training.jsonl"
    found = [json.loads(line) for line in path.read_text().splitlines()]
    count: dict[tuple[int, int], int] = {}
    for row in found:
        key = row["seed"], row["stage"]
        place = count[key] = count.get(key, -1) + 1
        row["segment"] = SEGMENTS[row["seed"]][row["stage"]][place]
    path.write_text("".join(json.dumps(row) + "\n" for row in found))
    return folder


def test_delays_and_false_alarms(tmp_path: Path) -> None:
    run = read_run(write(tmp_path / "run"))
    at = run.segments[0][0]
    first, second, third = noticed_changes.noticed(run)
    np.testing.assert_array_equal(first.delays, [np.nan, np.nan])
    np.testing.assert_array_equal(first.false_alarms, [0, 1])
    np.testing.assert_array_equal(second.delays, [at[0], np.nan])
    np.testing.assert_array_equal(second.false_alarms, [1, 0])
    np.testing.assert_array_equal(third.delays, [np.nan, at[1]])
    np.testing.assert_array_equal(third.false_alarms, [0, 2])
    table = noticed_changes.table(summarize([run]))
    assert [row[2] for row in table.rows] == ["–", "1 of 2", "1 of 2"]
    assert [row[4] for row in table.rows] == ["1", "1", "2"]
    assert run_report.task_tables(summarize([run]))[-1] == table


def test_diverged_seeds_do_not_count(tmp_path: Path) -> None:
    run = read_run(write(tmp_path / "run", diverged=(1,)))
    second = noticed_changes.noticed(run)[1]
    assert second.delays.tolist() == [run.segments[1][0][0]]
    table = noticed_changes.table(summarize([run]))
    assert [row[2] for row in table.rows] == ["–", "1 of 1", "0 of 1"]


def test_runs_that_are_told_the_tasks_have_none(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "run"))
    assert noticed_changes.noticed(run) == ()
    assert noticed_changes.table(summarize([run])).rows == []
    assert noticed_changes.to_json(run) == {}
    assert len(run_report.task_tables(summarize([run]))) == 1
