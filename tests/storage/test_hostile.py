"""What lies in a run folder is never executed, and harms nobody who reads it."""

import hashlib
import json
import os
import pickle
import shutil
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tensorstore

import rewire_jax
from rewire_jax.cli import main
from rewire_jax.storage.run_folder import HEADER
from rewire_jax.storage.run_results import read_run
from tests.command_line import TINY

TASKS = ["--tasks", "3", "--checkpoint-every", "160"]
NEWEST = "checkpoints/task-003"
POLICY, MANIFEST = f"{NEWEST}/policy", f"{NEWEST}/manifest.json"
TABLE = "results.jsonl"
HUGE = 10**12
DEEP = "[" * 100_000


class Payload:
    """Unpickled, it makes a folder."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def write(path, manifest):
    content = json.dumps(manifest["content"]).encode()
    manifest["sha256"] = hashlib.sha256(content).hexdigest()
    path.write_text(json.dumps(manifest))


def fingerprint(held):
    return [len(held), hashlib.sha256(held).hexdigest()]


def sign(folder):
    """Has the newest checkpoint list its files as they are now."""
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text())
    except (ValueError, RecursionError):  # It is the hostile one.
        return
    manifest["content"]["files"] = {
        file.relative_to(path.parent).as_posix(): fingerprint(file.read_bytes())
        for file in path.parent.rglob("*")
        if file.is_file() and file != path
    }
    write(path, manifest)


def pickled(name, folder, marker):
    (folder / name).write_bytes(pickle.dumps(Payload(marker)))
    sign(folder)


def pickled_array(name, folder, marker):
    array = np.array([Payload(marker)], object)
    np.save(folder / name, array, allow_pickle=True)
    sign(folder)


def text(name, content, folder, marker):
    (folder / name).write_text(content)
    sign(folder)


def row(content, folder, marker):
    with (folder / TABLE).open("a") as file:
        file.write(content + "\n")


def linked(name, to, folder, marker):
    (folder / name).unlink()
    (folder / name).symlink_to(to)


def pipe(name, folder, marker):
    (folder / name).unlink()
    os.mkfifo(folder / name)


def outside(folder, marker):
    """A checkpoint that takes a file outside itself for its own."""
    manifest = json.loads((folder / MANIFEST).read_text())
    name = f"policy/../../../../{folder.name}/{HEADER}"
    held = (folder / HEADER).read_bytes()
    manifest["content"]["files"][name] = fingerprint(held)
    write(folder / MANIFEST, manifest)


def enormous(folder, marker):
    """A small file that says that an array is 4 TB, signed."""
    files = {"driver": "file", "path": f"{(folder / POLICY).absolute()}/"}
    store = tensorstore.KvStore.open({"driver": "ocdbt", "base": files}).result()
    for key in store.list().result():
        if key.endswith(b".zarray"):
            array = json.loads(store.read(key).result().value)
            array["shape"] = [HUGE, *array["shape"][1:]]
            store.write(key, json.dumps(array).encode()).result()
    sign(folder)


def header(at, value, folder, marker):
    """Another value in the header, at a path of names."""
    whole = inner = json.loads((folder / HEADER).read_text())
    *names, last = at.split(".")
    for name in names:
        inner = inner[name]
    inner[last] = value
    # JSON has no infinity, but Python reads it.
    (folder / HEADER).write_text(json.dumps(whole))


PICKLES = (HEADER, TABLE, MANIFEST, f"{POLICY}/_METADATA", f"{POLICY}/manifest.ocdbt")
VALUES = (
    ("settings.method", "os.system"),
    ("settings.method", ["rewire"]),
    ("settings.scenario", "../../probe/reach"),
    ("settings.scenario", {"name": "probe/reach"}),
    ("settings.backend", "../mjx"),
    ("settings.options", ["modes"]),
    ("settings.options.__class__", "os.system"),
    ("settings.sac.hidden", HUGE),
    ("settings.sac.hidden", 10**400),
    ("settings.sac.depth", HUGE),
    ("settings.sac.discount", float("inf")),
    ("settings.sac.discount", 10**400),
    ("settings.seeds", HUGE),
    ("settings.options.modes", HUGE),
    ("settings", "probe/reach"),
    ("tasks", "../../etc/passwd"),
)
TRAPS = {
    **{f"a pickle as {name}": partial(pickled, name) for name in PICKLES},
    "a pickle of Orbax": partial(pickled, f"{POLICY}/checkpoint"),
    "a deep manifest": partial(text, MANIFEST, DEEP),
    "deep metadata": partial(text, f"{POLICY}/_METADATA", DEEP),
    "a deep header": partial(text, HEADER, DEEP),
    "a deep row": partial(row, DEEP),
    "a row of infinity": partial(row, '{"stage": 1e999}'),
    "a row of a huge number": partial(row, '{"stage": 1' + "0" * 5000 + "}"),
    "an endless header": partial(linked, HEADER, "/dev/zero"),
    "an endless table": partial(linked, TABLE, "/dev/zero"),
    "an endless array": partial(linked, f"{POLICY}/_METADATA", "/dev/zero"),
    "a link out": partial(linked, f"{POLICY}/_METADATA", "/etc/hostname"),
    "a pipe": partial(pipe, f"{POLICY}/manifest.ocdbt"),
    "a file outside": outside,
    "an array of 4 TB": enormous,
    **{f"{at}: {value!r:.20}": partial(header, at, value) for at, value in VALUES},
}
"""Each is given the folder, and what must not come to be."""
UNREAD = {
    "an array of pickles": partial(pickled_array, f"{POLICY}/0.npy"),
    "a pickle beside": partial(pickled, "policy.pkl"),
    "a pickle for a checkpoint": partial(pickled, "checkpoints/task-004"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hostile") / "run"
    main.main(["train", "probe/reach", "--out", str(folder), *TINY, *TASKS])
    return folder


@pytest.fixture(autouse=True)
def impatient():
    """What waits for ever, as for a pipe that nobody writes to, fails."""

    def stop(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("name", [*TRAPS, *UNREAD])
def test_a_trap_is_an_error_in_one_line(name: str, run: Path, tmp_path: Path) -> None:
    folder, marker = tmp_path / "run", tmp_path / "marker"
    shutil.copytree(run, folder)
    (TRAPS | UNREAD)[name](folder, marker)
    told = []
    for read in (
        read_run,
        rewire_jax.load_policies,
        lambda folder: rewire_jax.load_policy(folder, task=0),
        lambda folder: rewire_jax.evaluate(folder, episodes=2),
    ):
        try:
            read(folder)
        except rewire_jax.UserError as error:
            told.append(str(error))
    assert not marker.exists()
    assert told or name in UNREAD
    assert not any("\n" in line for line in told)
