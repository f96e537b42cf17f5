import errno
import fcntl
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rewire_jax.core.errors import UserError, writing
from rewire_jax.core.settings_json import to_json
from rewire_jax.run import run_checkpoints
from rewire_jax.storage import run_folder
from rewire_jax.storage.run_folder import HEADER, held
from rewire_jax.version import __version__
from tests.tiny import tiny

HEAD = {"settings": to_json(tiny()), "provenance": {"versions": {}, "commit": "abc"}}


def test_one_at_a_time_has_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with held(folder, HEAD):
        for header in (None, HEAD):
            with pytest.raises(UserError), held(folder, header):
                raise AssertionError
    with held(folder, None):
        pass
    with pytest.raises(UserError), held(folder, HEAD):
        raise AssertionError


HOLDS = """
import sys, time
from pathlib import Path
from rewire_jax.storage.run_folder import held
with held(Path(sys.argv[1]), None):
    print("held", flush=True)
    time.sleep(600)
"""


def test_another_process_has_a_folder_until_it_is_killed(tmp_path: Path) -> None:
    with held(tmp_path, HEAD):
        pass
    words = [sys.executable, "-c", HOLDS, str(tmp_path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with pytest.raises(UserError, match="--resume"), held(tmp_path, None):
            raise AssertionError
        process.kill()
    with held(tmp_path, None):
        pass


@pytest.mark.parametrize("kind", ["link", "broken link", "pipe", "folder"])
def test_a_lock_that_is_no_file_is_left_alone(tmp_path: Path, kind: str) -> None:
    folder, outside = tmp_path / "run", tmp_path / "outside"
    folder.mkdir()
    lock = folder / ".lock"
    if kind == "link":
        outside.write_text("thesis")
    if kind == "pipe":
        os.mkfifo(lock)
    elif kind == "folder":
        lock.mkdir()
    else:
        lock.symlink_to(outside)
    before = outside.exists()
    with pytest.raises(UserError, match=r"\.lock"), held(folder, HEAD):
        raise AssertionError
    assert outside.exists() == before
    assert not before or outside.read_text() == "thesis"
    assert [path.name for path in folder.iterdir()] == [".lock"]


def test_a_file_system_without_locks_will_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with held(tmp_path, HEAD):
        pass


def test_a_start_that_was_cut_short_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    (tmp_path / f".{HEADER}").write_text("{")
    with pytest.raises(UserError), held(tmp_path, None):
        raise AssertionError
    with held(tmp_path, HEAD):
        assert run_folder.read_header(tmp_path)["format"] == run_folder.FORMAT


def test_nothing_is_left_where_something_else_is(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    for header in (HEAD, None):
        with pytest.raises(UserError), held(tmp_path, header):
            raise AssertionError
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("code", "told", "not_told"),
    [
        (errno.ENOSPC, "free space", "ulimit"),
        (errno.EDQUOT, "free space", "ulimit"),
        (errno.EROFS, "writable", "free space"),
        (errno.EACCES, "permissions", "free space"),
        (errno.EMFILE, "ulimit -n", "free space"),
        (errno.ENFILE, "ulimit -n", "free space"),
    ],
)
def test_what_helps_depends_on_what_failed(
    code: int, told: str, not_told: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=told) as caught, writing(tmp_path):
        raise OSError(code, os.strerror(code), str(tmp_path))
    assert not_told not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda head: head["settings"].update(lookahead=1),
            "unknown setting lookahead",
        ),
        (lambda head: head["settings"]["sac"].update(a=1), "unknown setting a"),
        (lambda head: head["settings"].pop("tasks"), "no setting tasks"),
        (lambda head: head.update(format=7), "format 7, not 1"),
    ],
)
def test_settings_of_another_version_name_it(change, said, tmp_path: Path) -> None:
    head = json.loads(json.dumps(HEAD)) | {"format": run_folder.FORMAT}
    change(head)
    for versions, named in (
        ({"rewire_jax": "9.8"}, "written by rewire_jax 9.8, commit abc"),
        ({}, "written by rewire_jax of an unknown version"),
        ({"rewire_jax": __version__}, ""),
    ):
        head["provenance"]["versions"] = versions
        (tmp_path / HEADER).write_text(json.dumps(head))
        for read in (
            lambda: run_checkpoints.saved(tmp_path),
            lambda: run_folder.compare(tmp_path, tiny()),
        ):
            with pytest.raises(UserError, match=said) as caught:
                read()
            assert named in str(caught.value)
            # Only where another version wrote it is that of interest.
            assert bool(named) == ("written by" in str(caught.value))


def test_what_was_written_since_is_cut_off(tmp_path: Path) -> None:
    run_folder.append(tmp_path, "results.jsonl", [{"a": 1}, {"a": 2}])
    marks = json.loads(json.dumps(run_folder.marks(tmp_path)))
    run_folder.append(tmp_path, "results.jsonl", [{"a": 3}])
    run_folder.append(tmp_path, "timing.jsonl", [{"a": 4}])
    assert run_folder.changed(tmp_path, marks) is None
    run_folder.cut(tmp_path, marks)
    assert (tmp_path / "results.jsonl").read_text() == '{"a": 1}\n{"a": 2}\n'
    assert (tmp_path / "timing.jsonl").read_text() == ""


@pytest.mark.parametrize("text", ['{"a": 1}\n{"a"', '{"a": 1}\n{"a": 7}\n', ""])
def test_rows_that_are_lost_or_others_are_noticed(tmp_path: Path, text: str) -> None:
    run_folder.append(tmp_path, "results.jsonl", [{"a": 1}, {"a": 2}])
    marks = run_folder.marks(tmp_path)
    (tmp_path / "results.jsonl").write_text(text)
    assert run_folder.changed(tmp_path, marks) == tmp_path / "results.jsonl"
    # Earlier versions noted lengths alone.
    lengths = {"results.jsonl": 18}
    noticed = run_folder.changed(tmp_path, lengths) is not None
    assert noticed == (len(text) < 18)


@pytest.fixture
def outside(tmp_path):
    """A file outside of the folder `run`."""
    (tmp_path / "run").mkdir()
    path = tmp_path / "outside"
    path.write_text("precious")
    return path


def test_a_header_is_not_written_through_a_link(tmp_path, outside):
    folder = tmp_path / "run"
    (folder / ".settings.json").symlink_to(outside)
    run_folder.write(folder / "settings.json", {"a": 1})
    assert outside.read_text() == "precious"
    assert not (folder / "settings.json").is_symlink()


def test_a_table_with_another_name_elsewhere_is_not_written(tmp_path, outside):
    folder = tmp_path / "run"
    (folder / "results.jsonl").hardlink_to(outside)
    with pytest.raises(UserError, match="results"):
        run_folder.append(folder, "results.jsonl", [{"a": 1}])
    with pytest.raises(UserError, match="results"):
        run_folder.cut(folder, {})
    assert outside.read_text() == "precious"
