"""Runs with simulators: what they write, and how they are stopped and resumed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rewire_jax.envs.vector_env import open_lanes
from rewire_jax.run import interrupts, train_run
from tests import walk
from tests.tiny import rows
from tests.walk_loop import settings

pytestmark = pytest.mark.usefixtures("one_core")

TRAIN = "train continual_world/t3 --method ft1 --profile quick --warmup 200"
TRAIN += " --update-every 40 --hidden 8 --batch-size 8 --eval-episodes 1"


def command(words: str, out: Path) -> list[str]:
    """Trains with real simulators."""
    start = [sys.executable, "-m", "rewire_jax.cli.main", *TRAIN.split()]
    return [*start, *words.split(), "--out", str(out)]


def test_a_run_tells_of_success(tmp_path):
    made = settings(interactions=160)
    folder = train_run.train(
        made, tmp_path / "run", scenario=walk.scenario(walk.walker(0.5))
    )
    results = rows(folder)
    assert len(results) == 3 * 2
    assert all(0 <= row["success_last"] <= row["success"] <= 1 for row in results)
    reports = rows(folder, "training.jsonl")
    assert [row["interactions"] for row in reports] == [40, 80, 120, 160] * 2
    assert all("success" in row and "success_last" in row for row in reports)


@pytest.mark.slow
def test_a_killed_run_resumes_in_the_middle_of_an_episode(tmp_path):
    # Real simulators; the checkpoint lies within an episode of 200 steps.
    words = "--tasks 2 --interactions 2160 --updates 2"
    words += " --report-every 120 --checkpoint-every 1240"
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    one = subprocess.Popen(command(words, whole), stderr=subprocess.PIPE)
    process = subprocess.Popen(command(words, killed), stderr=subprocess.PIPE)
    table = killed / "training.jsonl"
    while process.poll() is None:
        # In the second task, past its checkpoint.
        if table.exists() and len(table.read_text().splitlines()) >= 18 + 12:
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.002)
    assert process.wait() == -signal.SIGKILL
    (kept,) = (killed / "checkpoints").glob("task-001-step-*")
    assert int(kept.name.rpartition("-")[2]) % 200 != 0
    again = [*command(words, killed), "--resume"]
    subprocess.run(again, check=True, capture_output=True)
    assert one.wait() == 0
    for name in ("results.jsonl", "training.jsonl"):
        assert (killed / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.parametrize(
    ("method", "overlap"),
    [
        ("ft1", True),
        pytest.param("rewire", True, marks=pytest.mark.slow),
        pytest.param("csp", False, marks=pytest.mark.slow),
    ],
)
def test_what_is_needed_within_a_task_is_saved(method, overlap, tmp_path, monkeypatch):
    made = settings(method, overlap=overlap, interactions=240, checkpoint_every=100)
    scenario = walk.scenario(walk.walker(0.5))
    whole = train_run.train(made, tmp_path / "whole", scenario=scenario)
    called = train_run.Run.chunk

    def stopping(self, now, task):
        if now.stage == 1 and now.steps == 120:
            raise KeyboardInterrupt
        return called(self, now, task)

    with monkeypatch.context() as patch:
        patch.setattr(train_run.Run, "chunk", stopping)
        with pytest.raises(interrupts.Stopped):
            train_run.train(made, tmp_path / "stopped", scenario=scenario)
    assert list((tmp_path / "stopped" / "checkpoints").glob("task-001-step-*"))
    open_lanes.cache_clear()
    resumed = train_run.train(
        made, tmp_path / "stopped", scenario=scenario, resume=True
    )
    for name in ("results.jsonl", "training.jsonl"):
        assert (resumed / name).read_bytes() == (whole / name).read_bytes()


def test_ctrl_c_leaves_the_simulators_until_all_is_saved(tmp_path):
    words = "--tasks 1 --seeds 2 --interactions 20000 --updates 1"
    words += " --report-every 80 --checkpoint-every 0"
    process = subprocess.Popen(
        command(words, tmp_path / "run"),
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )
    table = tmp_path / "run" / "training.jsonl"
    while process.poll() is None and not table.exists():
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate()
    assert process.returncode == 130
    assert "Traceback" not in said
    assert "--resume" in said
    assert list((tmp_path / "run" / "checkpoints").glob("task-000-step-*"))
