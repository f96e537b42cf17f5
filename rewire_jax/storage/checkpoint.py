"""Checkpoints: folders of arrays that are complete or not there.

A checkpoint holds named items, each a pytree of arrays in an Orbax folder of its
own, so that a policy is read without the replay buffer. `manifest.json`
lists the leaves of each item and the size and SHA-256 of each file. All is written
under a temporary name and renamed when it is on disk: give checkpoints names of
their own, in the order of time. A folder of checkpoints has one writer at a time.
"""

import contextlib
import errno
import hashlib
import itertools
import json
import logging
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.errors import UserError, remedy
from rewire_jax.version import __version__

_FORMAT = 3
_MANIFEST = "manifest.json"
_TEMPORARY = ".tmp-"
_KINDS = (np.bool_, np.number, jax.dtypes.prng_key)
# Errors of what is not there, or is something else; those that we raise have none.
_MISSING = (None, errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP)


class CheckpointError(UserError):
    """A checkpoint that is missing or damaged."""


class ForeignError(UserError):
    """A checkpoint that is whole, but not what this version would have written."""


def save(path: Path, items: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Writes a checkpoint; it is complete or not there.

    Args:
      path: the folder to create; it replaces an existing folder at the last moment.
      items: pytrees of arrays, by the name under which `load` finds them.
      metadata: what JSON can hold.

    Raises:
      UserError: the disk is full or the folder cannot be written.
      TypeError: a leaf is not an array of numbers.
    """
    path = Path(path).absolute()  # Orbax refuses relative paths.
    content: dict[str, Any] = {
        "version": __version__,
        "metadata": dict(metadata),
        "items": {name: [*_describe(name, tree)] for name, tree in items.items()},
    }
    temporary = path.parent / f"{_TEMPORARY}{path.name}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for left_over in path.parent.glob(f"{_TEMPORARY}*"):
            _clear(left_over)
        temporary.mkdir()
        for name, tree in items.items():
            _write_item(temporary / name, tree)
        files = sorted(file for file in temporary.rglob("*") if file.is_file())
        content["files"] = {
            file.relative_to(temporary).as_posix(): _fingerprint(file) for file in files
        }
        manifest = {"format": _FORMAT, "sha256": _digest(content), "content": content}
        (temporary / _MANIFEST).write_text(json.dumps(manifest, indent=1))
        for entry in [*temporary.rglob("*"), temporary]:
            _sync(entry)
        _clear(path)
        temporary.rename(path)
        _sync(path.parent)
    except (OSError, ValueError) as error:  # TensorStore's are ValueErrors.
        raise UserError(
            f"cannot write checkpoint {path}: {_reason(error)}; "
            f"{remedy(_code(error))} (earlier checkpoints are untouched)"
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _clear(path: Path) -> None:
    """Deletes what stands in the way: a folder, or a file or link by itself."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def load(
    path: Path, items_like: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Verifies and reads the named items; files of other items are not touched.

    Args:
      path: the checkpoint.
      items_like: for each item wanted, a pytree of arrays or
        `jax.ShapeDtypeStruct` with its structure, shapes and dtypes.

    Returns:
      The items with numpy arrays, wherever the saved ones lived, and the metadata.

    Raises:
      CheckpointError: it is missing or damaged.
      ForeignError: it differs from `items_like`, or is of another format.
      UserError: the system does not let it be read.
    """
    path = Path(path).absolute()
    content = _read_manifest(path)
    try:
        for name, like in items_like.items():
            stored = content["items"].get(name, ())
            for have, want in itertools.zip_longest(stored, _describe(name, like)):
                if have != want:
                    what = f"{have or 'no leaf'} where {want or 'no leaf'} is expected"
                    raise _foreign(path, content, f"it holds {what}")
            _verify(path, name, content["files"])
        items = {name: _read_item(path / name, x) for name, x in items_like.items()}
        return items, content["metadata"]
    except (ForeignError, MemoryError):
        raise
    # What is not its own makes Orbax fail in many ways.
    except Exception as error:
        raise _unreadable(path, error) from error


def read_metadata(path: Path) -> dict[str, Any]:
    """Reads the metadata only.

    Raises:
      CheckpointError: the manifest is missing or damaged.
      UserError: the system does not let it be read.
    """
    return _read_manifest(Path(path)).get("metadata", {})


def available(folder: Path) -> list[Path]:
    """Lists what look like complete checkpoints in `folder`, last by name first."""
    found = (file.parent for file in Path(folder).glob(f"[!.]*/{_MANIFEST}"))
    return sorted(found, reverse=True)


def newest_metadata(folder: Path) -> dict[str, Any]:
    """Reads the metadata of the newest checkpoint that can be read; {} without any."""
    for path in available(folder):
        # It may be damaged, or just replaced by a run that goes on.
        with contextlib.suppress(UserError):
            return read_metadata(path)
    return {}


def remove(paths: Iterable[Path]) -> None:
    """Deletes checkpoints, each out of sight before it is taken apart."""
    for path in paths:
        gone = path.rename(path.with_name(f"{_TEMPORARY}{path.name}"))
        shutil.rmtree(gone, ignore_errors=True)


def _describe(item: str, tree: Any) -> Iterator[str]:
    """Yields a line for each leaf, such as `policy['w'] float32[3,4]`."""
    for key_path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = item + jax.tree_util.keystr(key_path)
        dtype = getattr(leaf, "dtype", object)
        if not any(jnp.issubdtype(dtype, kind) for kind in _KINDS):
            raise TypeError(f"{name} is not an array of numbers: {leaf!r}")
        yield f"{name} {dtype}[{','.join(map(str, leaf.shape))}]"


def _verify(path: Path, item: str, files: Mapping[str, Any]) -> None:
    """Raises `OSError` or `ValueError` unless an item's files are those written."""
    root = path.resolve()
    written = {name: x for name, x in files.items() if name.split("/")[0] == item}
    for name, fingerprint in written.items():
        file = path / name
        # Neither a link to elsewhere, nor a device that has no end.
        if file.resolve(strict=True) != root / name or not file.is_file():
            raise ValueError(f"{name} is no file of its own")
        same = file.stat().st_size == fingerprint[0]
        if not same or _fingerprint(file) != fingerprint:
            raise ValueError(f"{name} has other bytes than were written")
    for file in (path / item).rglob("[!.]*"):
        name = file.relative_to(path).as_posix()
        # Orbax reads some files just because they are there.
        if name not in written and not file.is_dir():
            raise ValueError(f"{name} is foreign")


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _write_item(folder: Path, tree: Any) -> None:
    leaves = [
        jax.random.key_data(x) if _is_key(x) else x for x in jax.tree.leaves(tree)
    ]
    # Orbax gets numbered host arrays, so that its files hold neither our classes nor
    # our devices. It stores no empty arrays and no empty trees.
    arrays = {str(i): np.asarray(x) for i, x in enumerate(leaves) if x.size}
    if arrays:
        with _orbax() as (ocp, orbax), ThreadPoolExecutor(1) as pool:
            # An interrupt waits for a thread that has begun: what Orbax has started
            # would go on without its folder, and log that it fails.
            pool.submit(int).result()
            saved = ocp.args.PyTreeSave(arrays)
            pool.submit(orbax.save, folder, args=saved).result()


def _read_item(folder: Path, like: Any) -> Any:
    leaves, structure = jax.tree.flatten(like)
    names = [str(i) for i, x in enumerate(leaves) if 0 not in x.shape]
    if names:
        with _orbax() as (ocp, orbax):
            host = ocp.RestoreArgs(restore_type=np.ndarray)
            args = ocp.args.PyTreeRestore(
                item=dict.fromkeys(names, 0), restore_args=dict.fromkeys(names, host)
            )
            _check_sizes(orbax.metadata(folder).item_metadata, like)
            arrays = orbax.restore(folder, args=args)
    for i, leaf in enumerate(leaves):
        if 0 in leaf.shape:
            leaves[i] = np.empty(leaf.shape, leaf.dtype)
        elif _is_key(leaf):
            impl = jax.random.key_impl(jnp.empty((), leaf.dtype))
            leaves[i] = jax.random.wrap_key_data(arrays[str(i)], impl=impl)
        else:
            leaves[i] = arrays[str(i)]
    return jax.tree.unflatten(structure, leaves)


def _check_sizes(found: Any, like: Any) -> None:
    """Raises `ValueError` unless stored arrays are as expected; reads none of them."""
    if found is None:
        raise ValueError("what arrays it has cannot be told")
    for i, leaf in enumerate(jax.tree.leaves(like)):
        if 0 not in leaf.shape:
            want = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
            have = found[str(i)]
            if (have.shape, have.dtype) != (want.shape, want.dtype):
                raise ValueError(f"array {i} is {have.dtype}{list(have.shape)}")


@contextlib.contextmanager
def _orbax() -> Iterator[tuple[Any, Any]]:
    """Orbax, and a synchronous checkpointer that reports only by exceptions."""
    # Here, because it takes long to import.
    import orbax.checkpoint as ocp

    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)  # It logs tracebacks when the disk is full.
    try:
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as orbax:
            yield ocp, orbax
    finally:
        logger.setLevel(level)


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        file = path / _MANIFEST
        if file.exists() and not file.is_file():
            raise ValueError
        manifest = json.loads(file.read_bytes())
        if manifest["format"] != _FORMAT:
            other = f"it has format {manifest['format']}, not {_FORMAT}"
            raise _foreign(path, manifest["content"], other)
        if manifest["sha256"] != _digest(manifest["content"]):
            raise ValueError
    except OSError as error:
        raise _unreadable(path, error) from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        damage = ValueError(f"{_MANIFEST} is damaged or foreign")
        raise _unreadable(path, damage) from error
    return manifest["content"]


def _unreadable(path: Path, error: Exception) -> UserError:
    told = f"cannot read checkpoint {path}: {_reason(error)}"
    if _code(error) not in _MISSING:
        # It may be whole: nobody should fall back from it.
        return UserError(f"{told}; {remedy(_code(error))}")
    return CheckpointError(told)


def _foreign(path: Path, content: Any, why: str) -> ForeignError:
    known = content if isinstance(content, dict) else {}
    written = known.get("version", "of an unknown version")
    if written != __version__:
        why += f"; it was written by rewire_jax {written}, not {__version__}"
    return ForeignError(
        f"checkpoint {path} does not fit: {why}: use what it was written with, or "
        "train in another folder"
    )


def _code(error: Exception) -> int | None:
    """The error number; TensorStore hides it in a long text."""
    if isinstance(error, OSError):
        return error.errno
    found = re.search(r"os_error_code='(\d+)'", str(error))
    return int(found[1]) if found else None


def _reason(error: Exception) -> str:
    """One line."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror} {error.filename or ''}".strip()
    code = _code(error)
    return os.strerror(code) if code else str(error).partition("\n")[0]


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _fingerprint(file: Path) -> list[Any]:
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return [file.stat().st_size, digest]


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
