"""Checkpoints whose writing replaces others, fails, waits or is killed."""

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import orbax.checkpoint as ocp
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.storage import checkpoint
from rewire_jax.storage.checkpoint import available, read_metadata, save
from tests.small_checkpoint import POLICY, assert_intact


def test_replacing_leaves_the_new_one_alone(saved: Path) -> None:
    save(saved, {"policy": np.zeros(2)}, {"order": 4})
    assert read_metadata(saved)["order"] == 4
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]
    assert not (saved / "rest").exists()


def test_left_overs_are_removed_by_the_next_save(saved: Path) -> None:
    left_over = saved.parent / ".tmp-during-9"
    (left_over / "item").mkdir(parents=True)
    save(saved.parent / "task-01", POLICY, {"order": 1})
    assert not left_over.exists()


@pytest.mark.parametrize("function", ["_write_item", "_sync"])
def test_a_full_disk_is_a_user_error(
    saved: Path, function: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint, function, fail)
    with pytest.raises(UserError, match="No space left on device; free") as caught:
        save(saved, {"policy": np.zeros(2)}, {"order": 4})
    assert str(saved) in str(caught.value)
    assert_intact(saved)
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


def test_a_folder_that_cannot_be_made_is_a_user_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="file") as caught:
        save(tmp_path / "file" / "task-00", POLICY, {"order": 0})
    assert "\n" not in str(caught.value)


def test_an_interrupt_waits_for_what_is_being_written(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = []

    def slow(self: Any, folder: Path, args: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.2)
        there.append(folder.parent.exists())

    monkeypatch.setattr(ocp.Checkpointer, "save", slow)
    # A command that was interrupted in this process leaves the signal ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            save(saved.parent / "task-01", POLICY, {"order": 1})
    finally:
        signal.signal(signal.SIGINT, before)
    assert there == [True]
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


# Forks, so that JAX and Orbax are imported once; the parent does not use them before,
# for their threads would not survive. Each child dies by SIGKILL at another of the
# calls that change the disk (every third), until there are no more of them.
KILLED = """
import os, shutil, signal, sys, warnings
from pathlib import Path
import numpy as np
from rewire_jax.storage import checkpoint

warnings.simplefilter("ignore")  # of forking

def save(path, last_call):
    calls = 0
    def dying(function):
        def run(*args, **kwargs):
            nonlocal calls
            calls += 1
            if calls == last_call:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*args, **kwargs)
        return run
    for name in ("_write_item", "_fingerprint", "_sync"):
        setattr(checkpoint, name, dying(getattr(checkpoint, name)))
    for name in ("rename", "mkdir", "unlink", "rmdir"):
        setattr(os, name, dying(getattr(os, name)))
    checkpoint.save(path, {"policy": {"w": np.ones((2, 3))}}, {"order": 1})

old = Path(sys.argv[1])
status, call = 1, 1
while status:
    folder = old.parents[1] / f"new-{call}"
    shutil.copytree(old, folder / "before")
    child = os.fork()
    if not child:
        save(folder / "new", call)
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    assert status in (0, signal.SIGKILL), status
    call += 3
"""


def test_a_kill_at_any_step_leaves_a_whole_one_or_none(saved: Path) -> None:
    arguments = [sys.executable, "-c", KILLED, str(saved)]
    subprocess.run(arguments, check=True, timeout=120)
    folders = sorted(saved.parents[1].glob("new-*"))
    assert len(folders) > 8
    newest = set()
    for folder in folders:
        found = available(folder)
        for path in found:
            assert_intact(path)
        assert folder / "before" in found
        newest.add(found[0].name)
    assert newest == {"before", "new"}
    killed = next(f for f in folders if any(f.glob(".tmp-*/policy")))
    save(killed / "next", POLICY, {})
    assert not any(killed.glob(".tmp-*"))


@pytest.mark.parametrize("limit", [50, 1000, 40_000])
def test_a_write_that_the_system_refuses(
    saved: Path, limit: int, capfd: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(0).normal(size=9000)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))  # bytes in a file
    try:
        with pytest.raises(UserError) as caught:
            save(saved, {"policy": noise}, {"order": 1})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    message = str(caught.value)
    assert message.startswith(f"cannot write checkpoint {saved}: File too large")
    assert "\n" not in message
    assert capfd.readouterr() == ("", "")
    assert_intact(saved)
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]
