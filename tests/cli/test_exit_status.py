"""How the command ends on an error, an interruption, or output that nothing takes."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from rewire_jax.cli import commands, main
from tests.command_line import fails

LIST = [sys.executable, "-m", "rewire_jax.cli.main", "list"]


def breaks(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    """`rewire-jax list` ends in an error of this kind."""

    def broken(self):
        raise error

    monkeypatch.setattr(commands.List, "__call__", broken)


@pytest.mark.parametrize("words", ["list", "list --debug", "--debug list"])
def test_what_is_unexpected_ends_in_a_line_too(
    words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    breaks(monkeypatch, RuntimeError("a surprise\nof two lines"))
    with pytest.raises(SystemExit) as exit_:
        main.main(words.split())
    assert exit_.value.code == 1
    *before, line = capsys.readouterr().err.splitlines()
    assert "RuntimeError: a surprise" in line
    assert any("in broken" in each for each in before) == ("--debug" in words)


def test_too_little_memory_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    breaks(monkeypatch, jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory"))
    assert "--seeds" in fails(capsys, "list")


LIMITS = {
    "open files": (OSError(errno.EMFILE, "Too many open files"), "ulimit -n"),
    "memory": (OSError(errno.ENOMEM, "Cannot allocate memory"), "--envs"),
}


@pytest.mark.parametrize(("error", "told"), LIMITS.values(), ids=LIMITS)
def test_a_limit_of_the_system_is_no_bug(
    error: OSError,
    told: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    breaks(monkeypatch, error)
    assert told in fails(capsys, "list")


@pytest.mark.skipif(sys.platform != "linux", reason="limits are those of Linux")
def test_too_little_memory_to_begin_with_is_told() -> None:
    words = ["sh", "-c", 'ulimit -v 800000; exec "$@"', "sh", *LIST]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "ulimit -v" in done.stderr
    assert done.stderr.count("\n") == 1


def test_an_interruption_shows_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    breaks(monkeypatch, KeyboardInterrupt())
    with pytest.raises(SystemExit) as exit_:
        main.main(["list"])
    assert exit_.value.code == 130
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_reader_that_has_gone_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(LIST, stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert done.returncode == 141
    assert not done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_output_that_nothing_takes_is_told_in_a_line() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(LIST, stdout=full, stderr=subprocess.PIPE, check=False)
    assert done.returncode == 2
    assert done.stderr.count(b"\n") == 1
    assert b"standard output" in done.stderr


def test_a_terminal_may_know_ascii_only() -> None:
    for words in ([*LIST[:-1], "--help"], [*LIST, "--unknown"]):
        done = subprocess.run(
            words,
            env=os.environ | {"PYTHONIOENCODING": "ascii"},
            capture_output=True,
            check=False,
        )
        assert done.returncode == (0 if "--help" in words else 2)
        assert b"unexpected" not in done.stderr
        assert b"Traceback" not in done.stderr


def test_closed_streams_are_no_error() -> None:
    for closed, code in ((">&-", 0), ("2>&-", 0), (">&- 2>&-", 0)):
        line = " ".join(LIST) + f" {closed}"
        done = subprocess.run(line, shell=True, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (code, "")


@pytest.mark.parametrize("where", ["2>&-", "2>/dev/full"])
def test_an_error_that_cannot_be_told_keeps_its_status(where: str) -> None:
    words = [*LIST[:-1], "info", "nope"]
    done = subprocess.run(
        " ".join(words) + f" {where}", shell=True, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (2, "")
