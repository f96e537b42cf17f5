"""Programs that are found again are not traced, and compute the same."""

import functools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core import kept_programs

POINTS = jnp.arange(6.0).reshape(2, 3)


class Pair(NamedTuple):
    left: Any
    right: dict[str, Any]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path) -> Iterator[Path]:
    kept_programs.keep_in(tmp_path / "programs")
    yield tmp_path / "programs"
    kept_programs.keep_in(None)


class Process:
    """The function as another process has it: traced, or found."""

    def __init__(self, name: str = "f", donate: tuple[int, ...] = ()):
        self.traced = 0
        compiled = functools.partial(jax.jit, donate_argnums=donate)
        self.call = kept_programs.kept(self.function, name, compiled)

    def function(self, pair: Pair, key: jax.Array) -> Pair:
        self.traced += 1
        noise = jax.random.normal(key, jnp.shape(pair.left))
        return Pair(pair.left + noise, {"sum": noise.sum(), "key": key})


def result(process: Process, left: Any = POINTS) -> Pair:
    return process.call(Pair(left, {}), jax.random.key(0))


def expected(left: Any = POINTS) -> np.ndarray:
    return np.asarray(left + jax.random.normal(jax.random.key(0), jnp.shape(left)))


def test_the_next_process_traces_nothing_and_computes_the_same(folder):
    first, second = Process(), Process()
    ours, theirs = result(first), result(second)
    assert (first.traced, second.traced) == (1, 0)
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    for pair in (ours, theirs):
        np.testing.assert_allclose(pair.left, expected(), rtol=1e-6)
        assert pair.right["key"] == jax.random.key(0)
    assert [path.stat().st_mode & 0o077 for path in folder.iterdir()] == [0]


def test_a_call_of_the_same_shapes_reads_nothing_again(folder):
    process = Process()
    result(process)
    for path in folder.iterdir():
        path.unlink()
    np.testing.assert_allclose(result(process, POINTS + 1).left, expected(POINTS + 1))
    assert process.traced == 1


@pytest.mark.parametrize("left", [POINTS[:1], POINTS.astype(jnp.float16), 1.0])
def test_other_arguments_have_another_program(left):
    result(Process())
    process = Process()
    np.testing.assert_allclose(result(process, left).left, expected(left), rtol=1e-2)
    assert process.traced == 1


def test_another_name_or_configuration_has_another_program():
    result(Process())
    other, configured = Process("g"), Process()
    result(other)
    with jax.numpy_rank_promotion("warn"):
        result(configured)
        result(configured)
    result(configured)
    assert (other.traced, configured.traced) == (1, 1)


@pytest.mark.parametrize("damage", ["cut", "flipped", "folder", "fifo"])
def test_damage_is_traced_anew(folder, damage):
    result(Process())
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    path.unlink()
    if damage == "folder":
        path.mkdir()
    elif damage == "fifo":
        os.mkfifo(path)
    else:
        content[len(content) // 2] ^= 1
        path.write_bytes(content if damage == "flipped" else content[:-10])
    process = Process()
    np.testing.assert_allclose(result(process).left, expected(), rtol=1e-6)
    assert process.traced > 0


def test_a_program_under_another_name_is_not_used(folder):
    result(Process())
    (first,) = folder.iterdir()
    other = Process("g")
    result(other)
    (second,) = {*folder.iterdir()} - {first}
    second.write_bytes(first.read_bytes())
    process = Process("g")
    result(process)
    assert process.traced > 0


def test_nothing_is_kept_of_code_that_has_changed_since(folder, monkeypatch):
    monkeypatch.setattr(kept_programs, "_read_code", lambda: "edited")
    np.testing.assert_allclose(result(Process()).left, expected(), rtol=1e-6)
    assert not folder.exists()


def test_memory_is_given_on():
    left = jnp.ones((2, 3))
    for _ in range(2):
        given = left + 0
        process = Process(donate=(0,))
        result(process, given)
        assert given.is_deleted()


def test_what_cannot_be_kept_is_compiled(folder):
    def function(x):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), jnp.float32), x)

    call = kept_programs.kept(function, "callback", jax.jit)
    assert call(1.0) == pytest.approx(np.sin(1.0))
    assert not folder.exists()


def test_an_error_of_the_function_is_its_own():
    def function(x):
        raise ValueError("of its own")

    call = kept_programs.kept(function, "error", jax.jit)
    with pytest.raises(ValueError, match="of its own"):
        call(1.0)


def test_a_folder_that_cannot_be_written_stops_nothing(tmp_path):
    file = tmp_path / "file"
    file.touch()
    kept_programs.keep_in(file / "programs")
    np.testing.assert_allclose(result(Process()).left, expected(), rtol=1e-6)


def test_it_can_be_lowered():
    text = Process().call.lower(Pair(POINTS, {}), jax.random.key(0)).as_text()
    assert "tensor<2x3xf32>" in text


def test_shapes_alone_need_no_trace():
    result(Process())
    process = Process()
    shapes = jax.eval_shape(process.call, Pair(POINTS, {}), jax.random.key(0))
    assert shapes.left.shape == POINTS.shape
    assert process.traced == 0


def test_a_function_around_a_named_one_has_no_name():
    def ours():
        pass

    kept_programs.give_name("ours", ours)
    around = functools.wraps(ours)(lambda: None)
    assert kept_programs.common_name(ours, ours) == "ours"
    assert kept_programs.common_name(ours, around) == ""
    assert kept_programs.common_name(around) == ""
