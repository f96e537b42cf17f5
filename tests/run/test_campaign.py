"""How a campaign's runs are trained, with processes that only sleep or fail."""

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.core.formatting import seconds
from rewire_jax.run.campaign import Crew, slots
from rewire_jax.run.campaign_file import PlannedRun, read_campaign
from rewire_jax.run.campaign_jobs import Job, last_line
from rewire_jax.run.campaign_population import decide, grouped, submitted_runs
from rewire_jax.run.campaign_status import status
from rewire_jax.storage import run_folder

TEXT = """
[[runs]]
scenarios = ["probe/reach"]
methods = ["ft1", "rewire"]
seeds = 2
profile = "quick"
"""
# Notes when it starts; makes its file on SIGINT, too.
TRAINS = """
import pathlib, signal, sys, time
folder, pause, status = pathlib.Path(sys.argv[1]), *map(float, sys.argv[2:])
folder.mkdir(parents=True, exist_ok=True)
with (folder.parent / "order.txt").open("a") as file:
    print(folder.name, file=file)
def stop(*_):
    (folder / "saved").touch()
    sys.exit(130)
signal.signal(signal.SIGINT, stop)
time.sleep(pause)
if not status:
    (folder / "done").touch()
print("the last word")
sys.exit(int(status))
"""


@dataclass(frozen=True)
class Pretended(Job):
    """A job whose process only sleeps."""

    pause: float = 0.0
    status: int = 0

    @property
    def place(self) -> Path:
        return self.root / self.run.name.replace("/", "-")

    @property
    def done(self) -> bool:
        return (self.place / "done").exists()

    def start(self, cores=()):
        run_folder.make(self.notes)
        with (self.notes / "log.txt").open("ab") as log:
            words = [str(self.place), str(self.pause), str(self.status)]
            return subprocess.Popen(
                [sys.executable, "-c", TRAINS, *words], stdout=log, stderr=log
            )


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "campaign.toml"
    path.write_text(TEXT)
    return path


@pytest.fixture
def runs(file) -> tuple[PlannedRun, ...]:
    return read_campaign(file).runs


def order(root: Path) -> list[str]:
    return (root / "order.txt").read_text().split()


def test_every_run_is_trained_once_in_order(tmp_path, runs):
    jobs = [Pretended(tmp_path, run) for run in runs]
    Crew(jobs, [()], None).work()
    assert order(tmp_path) == [job.place.name for job in jobs]
    assert all(job.done for job in jobs)
    Crew(jobs, [()], None).work()
    assert len(order(tmp_path)) == len(jobs)


def test_side_by_side_there_are_as_many_as_cores(tmp_path, runs):
    jobs = [Pretended(tmp_path, run, pause=0.5) for run in runs]
    crew, most = Crew(jobs, [(), ()], None), 0
    say = crew.say

    def said(what):
        nonlocal most
        most = max(most, len(crew.training) + 1)  # The one that ended is out already.
        say(what)

    crew.say = said
    crew.work()
    assert most == 2
    assert sorted(order(tmp_path)) == sorted(job.place.name for job in jobs)


def test_what_fails_is_tried_again_last_and_then_set_aside(tmp_path, runs):
    bad, *good = (Pretended(tmp_path, run) for run in runs)
    bad = Pretended(tmp_path, bad.run, status=1)
    jobs = [bad, *good]
    Crew(jobs, [()], None).work()
    names = [job.place.name for job in jobs]
    assert order(tmp_path) == [*names, names[0]]
    told = status(jobs)
    assert told.failed == {bad.run.name: "the last word"}
    assert len(told.done) == len(good)
    Crew(jobs, [()], None).work()
    assert len(order(tmp_path)) == len(jobs) + 1
    bad.forgive()
    Crew(jobs, [()], None).work()
    assert len(order(tmp_path)) == len(jobs) + 3


def test_a_killed_process_is_named_by_its_signal(tmp_path, runs):
    job = Pretended(tmp_path, runs[0])
    run_folder.make(job.notes)
    (job.notes / "log.txt").write_text("epoch\n\n")
    assert "SIGKILL" in job.note_failure(-signal.SIGKILL)
    assert last_line(job.notes / "log.txt") == "epoch"


def test_it_stops_in_time_and_runs_are_saved(tmp_path, runs):
    jobs = [Pretended(tmp_path, run, pause=60) for run in runs]
    Crew(jobs, [(), ()], 3.0).work()
    saved = [(job.place / "saved").exists() for job in jobs]
    assert saved == [True, True, False, False]
    # Being stopped is no failure.
    assert [job.failures for job in jobs] == [0] * 4


def test_two_callers_share_the_runs(tmp_path, runs):
    jobs = [Pretended(tmp_path, run, pause=0.5) for run in runs]
    with jobs[0].claimed() as ours:
        assert ours
        assert jobs[0].running
        assert status(jobs).running == (runs[0].name,)
        others = Crew(jobs, [()], 3.0)
        others.work()
        assert runs[0].name.replace("/", "-") not in order(tmp_path)
    assert not jobs[0].running


def test_cores_are_shared_out():
    own = sorted(os.sched_getaffinity(0))
    if len(own) > 1:
        parts = slots(2)
        assert sorted([*parts[0], *parts[1]]) == own
    assert slots(len(own) + 1) == [()] * (len(own) + 1)


def test_a_decision_on_populations_is_kept(tmp_path, file):
    file.write_text('population = "always"\n' + TEXT)
    made = read_campaign(file)
    root = tmp_path / "out"
    assert [len(run.seeds) for run in decide(made, root, [()])] == [2, 2]
    file.write_text('population = "never"\n' + TEXT)
    with pytest.raises(UserError, match="population"):
        grouped(read_campaign(file), root)
    file.write_text(TEXT)  # auto
    assert [len(run.seeds) for run in grouped(read_campaign(file), root)] == [2, 2]


def test_submitted_runs_are_single_seeds_and_stay_so(tmp_path, file):
    made, root = read_campaign(file), tmp_path / "out"
    assert submitted_runs(made, root) == list(made.runs)
    assert decide(made, root, [()]) == list(made.runs)


@pytest.mark.parametrize(
    ("text", "expected"), [("150m", 9000), ("2h30m", 9000), ("90s", 90), ("1h1s", 3601)]
)
def test_times(text, expected):
    assert seconds(text) == expected


@pytest.mark.parametrize("text", ["", "150", "0m", "m", "1d", "-1m", "1m2h"])
def test_what_is_no_time(text):
    with pytest.raises(UserError):
        seconds(text)


def test_a_log_is_not_written_through_a_link(tmp_path, file):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    job = Job(tmp_path / "c", read_campaign(file).runs[0])
    job.notes.mkdir(parents=True)
    (job.notes / "log.txt").symlink_to(outside)
    with pytest.raises(UserError, match=r"log\.txt"):
        job.start()
    assert outside.read_text() == "mine"
