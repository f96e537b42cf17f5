"""Whatever happens to the files of a run, no command gives a wrong answer.

Each example damages the folder of a finished run in one to three ways and runs a
command. It ends with the right result or with one line, and no row is gone.
"""

import contextlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import rewire_jax
from rewire_jax.cli import main
from rewire_jax.storage.run_folder import TABLES
from tests.tiny import flags, tiny

SETTINGS = replace(tiny(method="ft1"), tasks=2)
RUN = ["train", "probe/reach", *flags(SETTINGS), "--out"]


class Said(NamedTuple):
    status: int
    out: str
    err: str


class Runs(NamedTuple):
    """A finished run, one of another seed, and what `evaluate` says of the first."""

    ours: Path
    other: Path
    evaluated: str


def say(*words: str | Path) -> Said:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main.main([str(word) for word in words])
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
    return Said(status, out.getvalue(), err.getvalue())


def evaluate(folder: Path) -> Said:
    return say("evaluate", folder, "--episodes", "1", "--json")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder = tmp_path_factory.mktemp("runs")
    assert say(*RUN, folder / "ours").status == 0
    assert say(*RUN, folder / "other", "--seed", "5").status == 0
    return Runs(folder / "ours", folder / "other", evaluate(folder / "ours").out)


def truncate(path: Path, number: int) -> None:
    os.truncate(path, path.stat().st_size * (number % 8) // 8)


def flip(path: Path, number: int) -> None:
    content = bytearray(path.read_bytes())
    if content:
        content[number % len(content)] ^= 1 << number % 8
        path.write_bytes(content)


def end_lines_otherwise(path: Path, _: int) -> None:
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))


def delete(path: Path, _: int) -> None:
    path.unlink()


def make_folder(path: Path, _: int) -> None:
    path.unlink()
    path.mkdir()


def make_fifo(path: Path, _: int) -> None:
    path.unlink()
    os.mkfifo(path)


DAMAGES: dict[str, Callable[[Path, int], None]] = {
    "delete": delete,
    "truncate": truncate,
    "flip": flip,
    "end lines otherwise": end_lines_otherwise,
    "folder": make_folder,
    "fifo": make_fifo,
}


def damage(kind: str, number: int, folder: Path, runs: Runs) -> None:
    """Damages a file, chosen by the number; half of the time a small one."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.is_symlink())
    near = [path for path in files if path.parent == folder or path.suffix == ".json"]
    chosen = near if number % 2 else files
    if not chosen:
        return
    path = chosen[number // 2 % len(chosen)]
    if kind == "delete checkpoints":
        target = folder / "checkpoints"
        if target.is_dir():
            shutil.rmtree(target)
    elif kind == "link":
        outside = folder.parent / f"outside-{number}-{path.name}"
        path.rename(outside)
        path.symlink_to(outside)
    elif kind == "swap":
        twin = runs.other / path.relative_to(folder)
        if twin.exists():
            shutil.copy(twin, path)
    else:
        DAMAGES[kind](path, number)


def lines(folder: Path) -> set[bytes]:
    """The whole rows of evaluations and training in files of the folder itself."""
    found: set[bytes] = set()
    for path in folder.iterdir():
        if path.name.startswith(TABLES[:2]) and path.is_file():
            found |= set(path.read_bytes().split(b"\n")[:-1])
    return found


COMMANDS = ("resume", "evaluate", "report", "load")


def check(damages: list[tuple[str, int]], command: str, runs: Runs) -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = shutil.copytree(runs.ours, Path(place) / "run")
        for kind, number in damages:
            damage(kind, number, folder, runs)
        before = lines(folder)
        outside = {p: p.read_bytes() for p in Path(place).glob("outside-*")}
        if command == "resume":
            said = say(*RUN, folder, "--resume")
            if said.status == 0:
                name = "results.jsonl"
                assert (folder / name).read_bytes() == (runs.ours / name).read_bytes()
        elif command == "evaluate":
            said = evaluate(folder)
            if said.status == 0:
                assert json.loads(said.out.splitlines()[0])
                assert said.out == runs.evaluated
        elif command == "report":
            said = say("report", folder, "--out", Path(place) / "report")
        else:
            try:
                rewire_jax.load_policies(folder)
                said = Said(0, "", "")
            except rewire_jax.UserError as error:
                said = Said(2, "", f"error: {error}")
        assert said.status in (0, 2), said.err
        if said.status:
            assert said.err.splitlines()[-1].startswith("error: "), said.err
            assert "unexpected" not in said.err, said.err
        assert "Traceback" not in said.err, said.err
        assert before <= lines(folder)
        assert all(path.read_bytes() == held for path, held in outside.items())


EXAMPLES = given(
    damages=st.lists(
        st.tuples(
            st.sampled_from(["swap", "link", "delete checkpoints", *DAMAGES]),
            st.integers(0, 10_000),
        ),
        min_size=1,
        max_size=3,
    ),
    command=st.sampled_from(COMMANDS),
)
ANY = settings(deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


@EXAMPLES
@settings(ANY, max_examples=30)
def test_no_damage_gives_a_wrong_answer(damages, command, runs: Runs) -> None:
    check(damages, command, runs)


@pytest.mark.slow
@EXAMPLES
@settings(ANY, max_examples=500)
def test_no_damage_of_many_gives_a_wrong_answer(damages, command, runs: Runs) -> None:
    check(damages, command, runs)
