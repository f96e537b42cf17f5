"""A campaign that is killed, or submitted, ends as one that nobody disturbed."""

import random
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.integration import command

SEEDS = 6
TEXT = f"""
title = "Twelve short runs"
tuned_on = []
population = "never"

[[runs]]
scenarios = ["probe/reach"]
methods = ["ft1", "rewire"]
seeds = {SEEDS}
profile = "quick"
[runs.settings]
tasks = 2
interactions = 640
envs = 16
updates = 4
warmup = 160
hidden = 8
depth = 1
batch_size = 16
eval_episodes = 2
selection_episodes = 2
report_every = 80
checkpoint_every = 160
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("campaign") / "twelve.toml"
    path.write_text(TEXT)
    return path


def train(file: Path, out: Path, *words: str) -> command.Ran:
    return command.run("campaign", file, "--out", out, *words)


@pytest.fixture(scope="module")
def undisturbed(file, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    ran = train(file, out)
    assert ran.returncode == 0, ran.stderr
    assert f"{2 * SEEDS} of {2 * SEEDS} runs finished" in ran.stdout
    return out


def table(out: Path) -> bytes:
    return (out / "returns.csv").read_bytes()


def rows(out: Path) -> dict[str, bytes]:
    """The results of every run."""
    found = (out / "probe").rglob("results.jsonl")
    return {str(path.relative_to(out)): path.read_bytes() for path in found}


@pytest.mark.slow
def test_killed_five_times_and_with_a_run_that_fails(file, undisturbed, tmp_path):
    rng, out = random.Random(0), tmp_path / "out"
    # The run finds a folder that is not its own.
    bad = out / "probe/reach/ft1/seed-2"
    bad.mkdir(parents=True)
    (bad / "notes.txt").touch()
    for _ in range(5):
        process = command.start("campaign", file, "--out", out)
        time.sleep(rng.uniform(5, 25))
        process.send_signal(signal.SIGKILL)
        process.communicate()
    ran = train(file, out)
    assert ran.returncode == 0, ran.stderr
    assert f"{2 * SEEDS - 1} of {2 * SEEDS} runs finished" in ran.stdout
    assert "failed: probe/reach/ft1/seed-2: error:" in ran.stdout
    assert (bad / "notes.txt").exists()
    shutil.rmtree(bad)
    ran = train(file, out, "--retry")
    assert ran.returncode == 0, ran.stderr
    assert table(out) == table(undisturbed)
    assert rows(out) == rows(undisturbed)


@pytest.mark.slow
def test_stopped_in_time_and_continued(file, undisturbed, tmp_path):
    out = tmp_path / "out"
    first = train(file, out, "--for", "30s")
    assert first.returncode == 0, first.stderr
    assert "missing: " in first.stdout
    while "missing: " in train(file, out, "--for", "60s").stdout:
        pass
    assert table(out) == table(undisturbed)
    assert rows(out) == rows(undisturbed)


@pytest.mark.slow
def test_submitted_here(file, undisturbed, tmp_path):
    out = tmp_path / "out"
    ran = train(file, out, "--submit", "local", "--workers", "2")
    assert ran.returncode == 0, ran.stderr
    assert train(file, out).returncode == 0  # writes the tables
    assert table(out) == table(undisturbed)
    assert rows(out) == rows(undisturbed)


SLURM = Path(__file__).parent / "start_slurm.sh"


@pytest.fixture
def slurm(tmp_path):
    """A Slurm of this machine alone, for this test."""
    started = subprocess.run(
        ["bash", SLURM, "start", tmp_path], capture_output=True, text=True, check=False
    )
    if started.returncode:
        pytest.skip(f"Slurm cannot start here: {started.stderr.strip()}")
    yield {"SLURM_CONF": str(tmp_path / "slurm.conf")}
    subprocess.run(["bash", SLURM, "stop", tmp_path], check=False)


@pytest.mark.slow
def test_submitted_to_slurm(file, undisturbed, tmp_path, slurm, monkeypatch):
    for name, value in slurm.items():
        monkeypatch.setenv(name, value)
    out = tmp_path / "out"
    ran = train(file, out, "--submit", "slurm", "--workers", "2", "--for", "10m")
    assert ran.returncode == 0, ran.stderr
    limit = time.monotonic() + command.PATIENCE
    while "missing: " in (told := train(file, out, "--status").stdout):
        assert time.monotonic() < limit, told
        time.sleep(5)
    while "running: " in train(file, out, "--status").stdout:
        time.sleep(1)
    assert train(file, out).returncode == 0  # writes the tables
    assert table(out) == table(undisturbed)
    assert rows(out) == rows(undisturbed)
