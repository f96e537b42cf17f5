import errno
import logging
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
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
from tests.small_checkpoint import POLICY, assert_identical, assert_intact


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


def test_nothing_is_logged_and_the_level_is_given_back(
    saved: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    level = logging.getLogger("absl").level
    load(saved, POLICY)
    save(saved, POLICY, {"order": 1})
    assert [r for r in caplog.records if r.name == "absl"] == []
    assert logging.getLogger("absl").level == level
