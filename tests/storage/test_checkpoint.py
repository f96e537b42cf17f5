import errno
import logging
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.storage import checkpoint
from rewire_jax.storage.checkpoint import (
    CheckpointError,
    ForeignError,
    available,
    load,
    read_metadata,
    remove,
    save,
)
from rewire_jax.version import __version__


class Pair(NamedTuple):
    left: Any
    right: Any


@flax.struct.dataclass
class State:
    params: Any
    step: Any


def tree() -> Any:
    nans = np.array([0x7FC00001, 0xFFC12345, 0x7F800001], np.uint32).view(np.float32)
    return {
        "nested": [Pair(jnp.arange(6.0).reshape(2, 3), (jnp.array(True), None))],
        "state": State(params={"w": jnp.ones((2, 2), jnp.bfloat16)}, step=jnp.int32(7)),
        "key": jax.random.PRNGKey(3),
        "typed_key": jax.random.split(jax.random.key(1), 2),
        "rbg": jax.random.key(1, impl="rbg"),
        "signs": np.array([-0.0, 0.0, np.inf]),
        "nans": nans,
        "negative_zero": np.full(4, -0.0, np.float32),
        "wide": np.array(2**60),
        "uint8": np.arange(3, dtype=np.uint8),
        "mask": jnp.array([True, False]),
        "empty": jnp.zeros((0, 3), jnp.bfloat16),
        "numpy_scalar": np.float16(0.1),
        "nothing": {},
    }


def like(value: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), value)


def assert_identical(actual: Any, expected: Any) -> None:
    assert str(jax.tree.structure(actual)) == str(jax.tree.structure(expected))
    for x, y in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert x.dtype == y.dtype
        assert x.shape == y.shape
        if jnp.issubdtype(y.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


POLICY = {"policy": {"w": np.ones((2, 3))}}


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("template") / "task-00"
    save(path, POLICY | {"rest": np.arange(9)}, {"order": 0})
    return path


@pytest.fixture
def saved(template: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(template, tmp_path / "checkpoints" / "task-00"))


def assert_intact(path: Path) -> None:
    assert_identical(load(path, POLICY)[0], POLICY)


@pytest.mark.parametrize("abstract", [False, True])
def test_round_trip_is_bit_identical(tmp_path: Path, abstract: bool) -> None:
    items = {"all": tree(), "one": jnp.float32(1.5), "none": ()}
    metadata = {"order": 3, "task": "ant", "returns": [0.1, None]}
    save(tmp_path / "a", items, metadata)
    expected = like(items) if abstract else items
    restored, found = load(tmp_path / "a", expected)
    assert_identical(restored, items)
    assert found == read_metadata(tmp_path / "a") == metadata
    assert type(restored["all"]["signs"]) is np.ndarray


def test_jitted_step_does_not_trace_again_after_a_load(tmp_path: Path) -> None:
    traces: list[None] = []

    @jax.jit
    def step(state: Any) -> Any:
        traces.append(None)
        return jax.tree.map(lambda x: x + 1, state)

    state = step({"w": jnp.ones(3), "n": jnp.uint32(0)})
    state = step(state)
    save(tmp_path / "a", {"state": state}, {"order": 0})
    step(load(tmp_path / "a", {"state": state})[0]["state"])
    assert len(traces) == 1


def test_only_the_named_items_are_read(saved: Path) -> None:
    shutil.rmtree(saved / "rest")
    assert_intact(saved)
    with pytest.raises(CheckpointError, match="No such file"):
        load(saved, {"rest": np.arange(9)})


def test_relative_path_and_moved_folder(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.move(saved.parents[0], tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path)
    assert_intact(Path("elsewhere/task-00"))
    save(Path("elsewhere/task-01"), POLICY, {"order": 1})
    assert_intact(tmp_path / "elsewhere" / "task-01")


def test_available_sorts_and_ignores_what_is_not_complete(saved: Path) -> None:
    folder = saved.parent
    assert available(folder / "absent") == []
    save(folder / "task-00-step-7", POLICY, {})
    save(folder / "task-01", POLICY, {})
    shutil.copytree(saved, folder / ".tmp-task-02")
    (folder / "foreign").mkdir()
    names = [path.name for path in available(folder)]
    assert names == ["task-01", "task-00-step-7", "task-00"]
    remove([folder / "task-01"])
    assert [path.name for path in folder.iterdir() if "01" in path.name] == []
    assert available(folder)[0].name == "task-00-step-7"


def largest(path: Path) -> Path:
    return max(
        (path / "policy").rglob("*"), key=lambda f: f.is_file() * f.stat().st_size
    )


def truncate(path: Path) -> None:
    file = largest(path)
    file.write_bytes(file.read_bytes()[:-1])


def flip(path: Path) -> None:
    file = largest(path)
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def change_manifest(path: Path, old: str, new: str) -> None:
    file = path / "manifest.json"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new, 1))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (truncate, "has other bytes"),
        (flip, "has other bytes"),
        (lambda path: largest(path).unlink(), "No such file"),
        (shutil.rmtree, "No such file"),
        (lambda path: (path / "manifest.json").unlink(), "manifest.json"),
        (lambda path: (path / "manifest.json").write_text("[1]"), "damaged or foreign"),
        (lambda path: (path / "manifest.json").write_text("{}"), "damaged or foreign"),
        (lambda path: (path / "manifest.json").write_bytes(b"\xff"), "damaged or for"),
        (lambda path: change_manifest(path, '"order": 0', '"order": 1'), "damaged or"),
    ],
)
def test_damage_is_told_in_one_line(saved: Path, damage: Any, says: str) -> None:
    damage(saved)
    with pytest.raises(CheckpointError, match=says) as caught:
        load(saved, POLICY)
    assert str(saved) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_may_be_whole_is_not_called_damaged(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Who falls back from a damaged checkpoint deletes what was made since.
    def failing(error: Exception) -> Any:
        def read(*_: Any) -> Any:
            raise error

        return read

    locked = PermissionError(errno.EACCES, "Permission denied", "x")
    monkeypatch.setattr(checkpoint, "_read_item", failing(locked))
    with pytest.raises(UserError, match=r"Permission denied.*permissions") as caught:
        load(saved, POLICY)
    assert not isinstance(caught.value, CheckpointError)
    monkeypatch.setattr(checkpoint, "_read_item", failing(MemoryError()))
    with pytest.raises(MemoryError):
        load(saved, POLICY)
    gone = FileNotFoundError(errno.ENOENT, "No such file", "x")
    monkeypatch.setattr(checkpoint, "_read_item", failing(gone))
    with pytest.raises(CheckpointError):
        load(saved, POLICY)


def test_another_format_names_the_version(saved: Path) -> None:
    change_manifest(saved, '"format": 3', '"format": 9')
    change_manifest(saved, f'"version": "{__version__}"', '"version": "9.8"')
    with pytest.raises(ForeignError, match=r"format 9, not 3; .* rewire_jax 9\.8"):
        load(saved, POLICY)


@pytest.mark.parametrize(
    ("expected", "says"),
    [
        ({"w": np.ones((2, 4))}, r"policy\['w'\] float64\[2,3\] .* float64\[2,4\]"),
        ({"w": np.ones((2, 3), np.float32)}, r"float64\[2,3\] where .* float32\[2,3\]"),
        ({"v": np.ones((2, 3))}, r"policy\['w'\] .* policy\['v'\]"),
        ({"w": np.ones((2, 3)), "x": np.ones(1)}, r"no leaf where policy\['x'\]"),
        ({}, r"policy\['w'\] float64\[2,3\] where no leaf"),
    ],
)
def test_other_structure_shape_or_dtype_names_the_leaf(
    saved: Path, expected: Any, says: str
) -> None:
    with pytest.raises(ForeignError, match=says) as caught:
        load(saved, {"policy": expected})
    assert "\n" not in str(caught.value)


def test_unknown_item(saved: Path) -> None:
    with pytest.raises(ForeignError, match="no leaf where critic"):
        load(saved, {"critic": np.ones(1)})


@pytest.mark.parametrize("leaf", [3, "text", np.array([None])])
def test_only_arrays_of_numbers_are_saved(saved: Path, leaf: Any) -> None:
    with pytest.raises(TypeError, match=r"policy\['w'\]"):
        save(saved, {"policy": {"w": leaf}}, {"order": 1})
    assert_intact(saved)


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


def test_nothing_is_logged_and_the_level_is_given_back(
    saved: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    level = logging.getLogger("absl").level
    load(saved, POLICY)
    save(saved, POLICY, {"order": 1})
    assert [r for r in caplog.records if r.name == "absl"] == []
    assert logging.getLogger("absl").level == level


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
