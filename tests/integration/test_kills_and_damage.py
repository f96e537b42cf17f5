"""Neither kills nor damage cost a finished result, or change one to come."""

import json
import os
import random
import shutil
import signal
import subprocess
import time
from functools import cache, partial

import pytest

from rewire_jax.storage import checkpoint
from rewire_jax.storage.run_folder import HEADER
from tests.integration import command
from tests.integration.command import LONG, RUN, SEEDS, SWEEP, TASKS, assert_refused

pytestmark = pytest.mark.slow
TRAINING, RESULTS, MIDDLE = "training.jsonl", "results.jsonl", "task-001-step-0000020"
FIRST, SECOND = "task-000/batch-000", "task-001/batch-001"


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """What a command leaves when nothing goes wrong; not to be changed."""

    @cache
    def folder(words):
        out = tmp_path_factory.mktemp("unbroken") / "run"
        ran = command.run(*words, "--out", out)
        assert ran.returncode == 0, ran.stderr
        return out

    return folder


@pytest.fixture
def finished(unbroken):
    return unbroken(RUN)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run killed in its second task, after a checkpoint; not to be changed."""
    out = tmp_path_factory.mktemp("stopped") / "run"
    kill(out, 0, f"checkpoints/{MIDDLE}", 0, *RUN)
    return out


def kill(out, delay, pattern, rows, *words):
    """Runs a command and kills it some seconds after a file is there."""
    process = command.start(*words, "--out", out)
    command.wait(process, out, pattern, rows)
    time.sleep(delay)
    process.kill()
    assert command.end(process).returncode == -signal.SIGKILL


def resume(words, out, whole):
    """Goes on with a run or sweep, to the result of the unbroken one."""
    ran = command.run(*words, "--out", out, "--resume")
    assert ran.returncode == 0, ran.stderr
    assert command.results(out) == command.results(whole)


def kept(out):
    """When each checkpoint of a finished task was written."""
    found = out.rglob("checkpoints/task-[0-9][0-9][0-9]")
    return {path: path.stat().st_mtime_ns for path in found}


# Seconds after a file is there, or is being written, with so many rows.
KILLS = {
    "before any checkpoint": (RUN, [(0, TRAINING, 2)]),
    "as a task begins": (RUN, [(0.05, "checkpoints/task-001", 0)]),
    "as a task ends": (RUN, [(0, RESULTS, 2 * TASKS * SEEDS)]),
    "in saving a task": (RUN, [(0, "checkpoints/*task-002", 0)]),
    "later in it": (RUN, [(0.02, "checkpoints/*task-002", 0)]),
    "in saving within a task": (RUN, [(0, f"checkpoints/*{MIDDLE}", 0)]),
    "later in that": (RUN, [(0.02, f"checkpoints/*{MIDDLE}", 0)]),
    "twice": (RUN, [(0, "checkpoints/*task-001", 0), (0, TRAINING, 18 * SEEDS)]),
    "after report 7": (RUN, [(0.3, TRAINING, 7 * SEEDS)]),
    "after report 16": (RUN, [(0.1, TRAINING, 16 * SEEDS)]),
    "in saving a sweep's batch": (SWEEP, [(0.01, f"{FIRST}/checkpoints/*task-001", 0)]),
    "in a sweep's second task": (SWEEP, [(0.1, f"{SECOND}/{TRAINING}", 2)]),
}


@pytest.mark.parametrize(("words", "kills"), KILLS.values(), ids=KILLS)
def test_it_is_killed(words, kills, unbroken, tmp_path):
    out, before = tmp_path / "run", {}
    for number, moment in enumerate(kills):
        kill(out, *moment, *words, *["--resume"] * bool(number))
        before |= kept(out)
    resume(words, out, unbroken(words))
    # What was finished is not trained again.
    assert kept(out).items() >= before.items()


STOPS = {
    "once": (1, RUN, TRAINING, 6),
    "once, in a sweep": (1, SWEEP, f"{SECOND}/checkpoints/*task-001-step-0000010", 0),
    "twice, in saving": (2, RUN, f"checkpoints/*{MIDDLE}", 0),
    "twice, in a chunk of seconds": (2, LONG, "checkpoints/task-001", 0),
}


@pytest.mark.parametrize(("times", "words", "seen", "rows"), STOPS.values(), ids=STOPS)
def test_ctrl_c_is_pressed(times, words, seen, rows, unbroken, tmp_path):
    out = tmp_path / "run"
    process = command.start(*words, "--out", out)
    command.wait(process, out, seen, rows)
    for number in range(times):
        time.sleep(0.2 if number or words == LONG else 0)
        os.killpg(process.pid, signal.SIGINT)
    ran = command.end(process)
    assert ran.returncode == 130, ran.stderr
    assert "Traceback" not in ran.stderr
    assert "--resume" in ran.stderr.splitlines()[-1]
    before = {path: path.read_bytes() for path in out.rglob("timing.jsonl")}
    if words == LONG:  # Pressed twice, the chunk that runs is not waited for.
        assert before[out / "timing.jsonl"].count(b"\n") == 1
    resume(words, out, unbroken(words))
    # All was saved: times are others where something is computed again.
    assert times == 2 or all(p.read_bytes().startswith(b) for p, b in before.items())


PAIRS = {
    "run": (RUN, TRAINING),
    "sweep": (SWEEP, f"{FIRST}/{TRAINING}"),
}


@pytest.mark.parametrize(("words", "seen"), PAIRS.values(), ids=PAIRS)
def test_a_second_process_comes(words, seen, unbroken, tmp_path):
    out = tmp_path / "run"
    first = command.start(*words, "--out", out)
    command.wait(first, out, seen, 4)
    first.send_signal(signal.SIGSTOP)  # It must not end before the second has looked.
    try:
        assert_refused(command.run(*words, "--out", out, "--resume"), out, "--out")
    finally:
        first.send_signal(signal.SIGCONT)
    assert command.end(first).returncode == 0
    assert command.results(out) == command.results(unbroken(words))


def truncate(held, draw):
    return held[: draw.randrange(len(held))]


def flip(held, draw):
    at = draw.randrange(len(held))
    return held[:at] + bytes([held[at] ^ 1 << draw.randrange(8)]) + held[at + 1 :]


def damage(change, seed, folder):
    """Changes a random file below a folder, at a random place."""
    draw = random.Random(seed)
    files = (path for path in folder.rglob("*") if path.is_file())
    path = draw.choice(sorted(path for path in files if path.stat().st_size))
    path.write_bytes(change(path.read_bytes(), draw))


def edit(table, how):
    def change(newest):
        path = newest.parents[1] / table
        path.write_text(how(path.read_text()))

    return change


def replace(name, make, folder):
    (folder / name).unlink()
    make(folder / name)


EDITS = {
    "cut": lambda text: text[:-9],
    "changed": lambda text: text.replace("0", "1", 1),
    "lost": lambda text: text.partition("\n")[2],
}
DAMAGE = {
    **{f"truncated {n}": ("stopped", partial(damage, truncate, n)) for n in range(2)},
    **{f"a bit flipped {n}": ("stopped", partial(damage, flip, n)) for n in range(2)},
    "no manifest": ("stopped", lambda newest: (newest / "manifest.json").unlink()),
    "a pipe": ("stopped", partial(replace, "counts/_METADATA", os.mkfifo)),
    **{f"{n} results": ("finished", edit(RESULTS, how)) for n, how in EDITS.items()},
    **{f"{n} training": ("finished", edit(TRAINING, how)) for n, how in EDITS.items()},
}


@pytest.mark.parametrize(("run", "change"), DAMAGE.values(), ids=DAMAGE)
def test_checkpoint_or_rows_are_damaged(run, change, finished, request, tmp_path):
    out = shutil.copytree(request.getfixturevalue(run), tmp_path / "run")
    change(checkpoint.available(out / "checkpoints")[0])
    resume(RUN, out, finished)


def test_a_policy_is_damaged(finished, tmp_path):
    out = shutil.copytree(finished, tmp_path / "run")
    second, third = (out / f"checkpoints/task-{number:03d}" for number in (2, 3))
    damage(flip, 1, second / "policy")
    ran = command.run("evaluate", out, "--stage", "1", "--episodes", "2")
    assert_refused(ran, second, "--resume")
    shutil.rmtree(second)
    shutil.rmtree(third)
    resume(RUN, out, finished)


def test_a_batch_of_a_sweep_is_damaged(unbroken, tmp_path):
    out = shutil.copytree(unbroken(SWEEP), tmp_path / "sweep")
    for later in ("task-001", "task-002"):
        shutil.rmtree(out / later)
    damage(flip, 0, out / FIRST / "checkpoints/task-001")
    assert_refused(command.run(*SWEEP, "--out", out, "--resume"), out / FIRST)
    shutil.rmtree(out / FIRST)
    resume(SWEEP, out, unbroken(SWEEP))


# In mounts of its own, which root has, and others where the system lets them.
APART = ("unshare", "--mount", "--map-root-user", "sh", "-ec")
LOCKED = 'mount --bind "$0" "$0"; mount -o remount,ro,bind "$0"; exec "$@"'
# What the command leaves is copied, as its disk goes with it.
SMALL = 'disk=$0; out=$1; mount -t tmpfs -o size="$2" tmpfs "$disk"; shift 2; '
SMALL += 'status=0; "$@" || status=$?; cp -a "$disk/." "$out"; exit "$status"'


@pytest.fixture
def disk(tmp_path):
    """An empty folder on which a disk can be mounted."""
    (tmp_path / "disk").mkdir()
    probe = [*APART, LOCKED, str(tmp_path / "disk"), "true"]
    if subprocess.run(probe, capture_output=True, check=False).returncode:
        pytest.skip("this system lets nobody but root mount a disk")
    return tmp_path / "disk"


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_the_disk_is_full(share, finished, disk, tmp_path):
    sizes = (path.stat().st_size for path in finished.rglob("*") if path.is_file())
    size = int(share * sum(-(-size // 4096) for size in sizes)) * 4096
    before = [*APART, SMALL, str(disk), str(tmp_path), str(size)]
    ran = command.run(*RUN, "--out", disk / "run", before=before)
    assert_refused(ran, disk / "run")
    assert command.results(tmp_path / "run") <= command.results(finished)
    resume(RUN, tmp_path / "run", finished)


LOCKS = {"new": RUN, "run": (*RUN, "--resume"), "report": ("report", "{}/run")}


@pytest.mark.parametrize(("name", "words"), LOCKS.items(), ids=LOCKS)
def test_the_folder_is_read_only(name, words, finished, stopped, disk):
    shutil.copytree(stopped, disk / "run")
    words = [*(word.format(disk) for word in words), "--out", disk / name]
    ran = command.run(*words, before=[*APART, LOCKED, str(disk)])
    assert_refused(ran, disk / name)
    resume(RUN, disk / "run", finished)


def foreign(folder):
    """As if a later version had one setting more."""
    header = json.loads((folder / HEADER).read_text())
    header["provenance"]["versions"]["rewire_jax"] = "98.7.6"
    header["settings"]["lookahead"] = 3
    (folder / HEADER).write_text(json.dumps(header))


METADATA = f"checkpoints/task-{TASKS:03d}/policy/_METADATA"
EVALUATE = "evaluate {run} --episodes 2"
RESUME = " ".join(RUN) + " --out {run} --resume"
ENDLESS = partial(replace, HEADER, partial(os.symlink, "/dev/zero"))
MISTAKES = {
    "a scenario": ("train probe/reech --out {new}", "probe/reach", None),
    "a value": ("sweep probe/reach --beta -1 1 --out {new}", "--beta", None),
    "another version": (EVALUATE, "98.7.6", foreign),
    "another to resume": (RESUME, "98.7.6", foreign),
    "a header without end": (EVALUATE, HEADER, ENDLESS),
    "a pipe": (EVALUATE, "_METADATA", partial(replace, METADATA, os.mkfifo)),
}


@pytest.mark.parametrize(("words", "told", "change"), MISTAKES.values(), ids=MISTAKES)
def test_command_or_folder_make_no_sense(words, told, change, finished, tmp_path):
    out = shutil.copytree(finished, tmp_path / "run")
    if change:
        change(out)
    ran = command.run(*words.format(run=out, new=tmp_path / "new").split())
    assert_refused(ran, told)
    assert ran.stderr.count("\n") == 1
    assert not (tmp_path / "new").exists()
