"""Run folders that someone has prepared: what lies in them must not be executed."""

import hashlib
import json
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tensorstore

from experiments.faults import base
from experiments.faults.base import TRAIN, Case, Kind, Outcome

_HUGE = 10**12
_POLICY = "checkpoints/task-003/policy"


class Payload:
    """Unpickled, it makes a file."""

    def __init__(self, marker: Path):
        """Nothing is made yet."""
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)


class Trap(NamedTuple):
    """Something hostile in a run folder.

    Attributes:
      name: of it.
      spring: puts it into a run folder; what must not be made is the other path.
      harmless: whether what stands there is never read, so that commands may work.
    """

    name: str
    spring: Callable[[Path, Path], object]
    harmless: bool = False


def pickled(name: str, folder: Path, marker: Path) -> None:
    """A pickle in place of a file, or beside the others."""
    path = folder / name
    path.write_bytes(pickle.dumps(Payload(marker)))
    sign(folder)


def pickled_array(name: str, folder: Path, marker: Path) -> None:
    """A NumPy file of objects, whose pickles would be loaded."""
    array = np.array([Payload(marker)], object)
    with (folder / name).open("wb") as file:
        np.save(file, array, allow_pickle=True)
    sign(folder)


def header(folder: Path, marker: Path, *, at: str, value: Any) -> None:
    """Another value in settings.json, at a path of names."""
    path = folder / "settings.json"
    whole = json.loads(path.read_text())
    inner = whole
    *names, last = at.split(".")
    for name in names:
        inner = inner[name]
    inner[last] = value
    # JSON has no infinity, but Python's reads it.
    path.write_text(json.dumps(whole))


def text(name: str, folder: Path, marker: Path, *, content: str) -> None:
    """Something else in a file."""
    (folder / name).write_text(content)
    sign(folder)


def row(folder: Path, marker: Path, *, content: str) -> None:
    """Something else as the last line of the results."""
    with (folder / "results.jsonl").open("a") as file:
        file.write(content + "\n")


def linked(name: str, folder: Path, marker: Path, *, to: str) -> None:
    """A link to elsewhere in place of a file."""
    (folder / name).unlink()
    (folder / name).symlink_to(to)


def pipe(name: str, folder: Path, marker: Path) -> None:
    """A pipe that nobody writes to in place of a file."""
    (folder / name).unlink()
    os.mkfifo(folder / name)


def outside(folder: Path, marker: Path) -> None:
    """A checkpoint that lists a file outside itself, and takes it for its own."""
    path = folder / "checkpoints/task-003/manifest.json"
    manifest = json.loads(path.read_text())
    name = f"policy/../../../../{folder.name}/settings.json"
    held = (folder / "settings.json").read_bytes()
    manifest["content"]["files"][name] = [len(held), hashlib.sha256(held).hexdigest()]
    _write(path, manifest)


def enormous(folder: Path, marker: Path) -> None:
    """A small file that says that an array is 4 TB, signed."""
    place = (folder / _POLICY).absolute()
    base_ = {"driver": "file", "path": f"{place}/"}
    store = tensorstore.KvStore.open({"driver": "ocdbt", "base": base_}).result()
    for key in store.list().result():
        if key.endswith(b".zarray"):
            array = json.loads(store.read(key).result().value)
            array["shape"] = [_HUGE, *array["shape"][1:]]
            store.write(key, json.dumps(array).encode()).result()
    sign(folder)


def sign(folder: Path) -> None:
    """Has the newest checkpoint list its files as they are now."""
    checkpoint = folder / "checkpoints/task-003"
    path = checkpoint / "manifest.json"
    try:
        manifest = json.loads(path.read_text())
    except (ValueError, RecursionError):  # it is the hostile one
        return
    files = [f for f in checkpoint.rglob("*") if f.is_file() and f != path]
    manifest["content"]["files"] = {
        file.relative_to(checkpoint).as_posix(): [
            file.stat().st_size,
            hashlib.sha256(file.read_bytes()).hexdigest(),
        ]
        for file in files
    }
    _write(path, manifest)


def _write(path: Path, manifest: dict[str, Any]) -> None:
    content = json.dumps(manifest["content"]).encode()
    manifest["sha256"] = hashlib.sha256(content).hexdigest()
    path.write_text(json.dumps(manifest))


def _header(at: str, value: Any) -> Trap:
    name = f"{at}: {value!r:.20}"
    return Trap(name, partial(header, at=at, value=value))


_DEEP = "[" * 100_000
_MANIFEST = "checkpoints/task-003/manifest.json"

FILES = (
    *(
        Trap(f"a pickle as {name}", partial(pickled, name))
        for name in (
            "settings.json",
            "results.jsonl",
            _MANIFEST,
            f"{_POLICY}/_METADATA",
            f"{_POLICY}/manifest.ocdbt",
        )
    ),
    *(
        Trap(f"a pickle beside it, as {name}", partial(make, name), harmless)
        for make, name, harmless in (
            (pickled, f"{_POLICY}/checkpoint", False),
            (pickled_array, f"{_POLICY}/0.npy", True),
            (pickled, "policy.pkl", True),
            (pickled, "checkpoints/task-004", True),
        )
    ),
    Trap("a manifest, deeply nested", partial(text, _MANIFEST, content=_DEEP)),
    Trap(
        "metadata, deeply nested", partial(text, f"{_POLICY}/_METADATA", content=_DEEP)
    ),
    Trap("an endless file", partial(linked, "settings.json", to="/dev/zero")),
    Trap("an endless table", partial(linked, "results.jsonl", to="/dev/zero")),
    Trap("an endless array", partial(linked, f"{_POLICY}/_METADATA", to="/dev/zero")),
    Trap(
        "a link out of a checkpoint",
        partial(linked, f"{_POLICY}/_METADATA", to="/etc/hostname"),
    ),
    Trap("a pipe", partial(pipe, f"{_POLICY}/manifest.ocdbt")),
    Trap("a file outside", outside),
    Trap("an array of 4 TB", enormous),
)
"""Files in a run folder that nobody should open."""

VALUES = (
    _header("settings.method", "os.system"),
    _header("settings.method", ["rewire"]),
    _header("settings.scenario", "../../probe/reach"),
    _header("settings.scenario", {"name": "probe/reach"}),
    _header("settings.backend", "../mjx"),
    _header("settings.options", ["modes"]),
    _header("settings.options.__class__", "os.system"),
    _header("settings.sac.hidden", _HUGE),
    _header("settings.sac.hidden", 10**400),
    _header("settings.sac.depth", _HUGE),
    _header("settings.sac.discount", float("inf")),
    _header("settings.sac.discount", 10**400),
    _header("settings.seeds", _HUGE),
    _header("settings.options.modes", _HUGE),
    _header("settings", "probe/reach"),
    _header("tasks", "../../etc/passwd"),
    Trap("settings.json, deeply nested", partial(text, "settings.json", content=_DEEP)),
    Trap("a row, deeply nested", partial(row, content=_DEEP)),
    Trap("a row of infinity", partial(row, content='{"stage": 1e999}')),
    Trap(
        "a row of a huge number", partial(row, content='{"stage": 1' + "0" * 5000 + "}")
    ),
)
"""What a file of the right kind may say."""


def commands(folder: Path, out: Path) -> Iterator[tuple[str | Path, ...]]:
    """All commands that read a run folder."""
    yield ("evaluate", folder, "--episodes", "2")
    yield ("report", folder, "--out", out)
    yield (*TRAIN, "--out", folder, "--resume")


def entered(trap: Trap, place: Path) -> Outcome:
    """Every command is given the folder; some may work, one at least must refuse."""
    whole = base.unbroken(place, *TRAIN)
    folder, marker = place / "run", place / "marker"
    shutil.copytree(whole, folder)
    trap.spring(folder, marker)
    ran = [limited(words) for words in commands(folder, place / "report")]
    wrong = [base.complaint(each) for each in ran if each.status]
    if marker.exists():
        wrong.insert(0, "it was executed")
    # Training may go back to a checkpoint that is whole.
    told = [each.said for each in ran if each.status or "falling back" in each.err]
    if not told and not trap.harmless:
        wrong.append("no command noticed it")
    return Outcome((told or [""])[0], base.first(*wrong), 0)


def limited(words: tuple[str | Path, ...]) -> base.Ran:
    """Runs a command that may neither wait for ever nor take all memory."""
    most = 16 << 30
    before = ["timeout", "60", "prlimit", f"--as={most}"]
    return base.run(*words, before=before)


KINDS = (
    Kind(
        "hostile",
        "a run folder holds pickles, links, or numbers that are meant to harm",
        tuple(Case(trap.name, partial(entered, trap)) for trap in FILES),
    ),
)
