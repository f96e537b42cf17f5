"""The files of a run: a header, and tables to which rows are appended.

settings.json     settings, task names, network sizes, provenance
results.jsonl     a row for each member and task of an evaluation
training.jsonl    a row for each progress report and member
timing.jsonl      a row for each progress report: wall-clock seconds
checkpoints/      `task-003` after three tasks, `task-003-step-…` in the next
.lock             locked by the training process
"""

import contextlib
import errno
import hashlib
import importlib.metadata
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax
from filelock import FileLock, Timeout

from rewire_jax.core.arguments import flag
from rewire_jax.core.errors import UserError, writing
from rewire_jax.core.settings import Settings
from rewire_jax.core.settings_json import from_json, to_json
from rewire_jax.storage.json_lines import document, raw, reading
from rewire_jax.version import __version__

FORMAT = 1
HEADER = "settings.json"
TABLES = ("results.jsonl", "training.jsonl", "timing.jsonl")
_LOCK = ".lock"
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP)  # of file systems without locks
Mark = Sequence[Any] | int
"""Length of a table in bytes, and their SHA-256; older versions noted the length."""
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "brax", "mujoco", "orbax-checkpoint")


def provenance() -> dict[str, Any]:
    """Returns the origin of a result: command, commit, versions, device."""
    root = Path(__file__).parents[2]
    commit = "unknown"
    # An installed package may be inside another repository.
    if (root / ".git").exists():
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            commit = subprocess.run(
                ["git", "-C", root, "describe", "--always", "--dirty", "--abbrev=12"],
                capture_output=True,
                text=True,
                check=True,
            ).stdout.strip()
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    versions["rewire_jax"] = __version__
    devices = jax.devices()
    return {
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "commit": commit,
        "versions": versions,
        "device": f"{len(devices)} x {devices[0].device_kind}, {os.cpu_count()} cores",
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


@contextlib.contextmanager
def held(
    folder: Path, header: Mapping[str, Any] | None, kind: str = "run"
) -> Iterator[None]:
    """Locks the folder of a run against other processes, within a `with` block.

    Args:
      folder: folder of the run or sweep.
      header: header of a new run; None to continue the existing one.
      kind: kind of the existing folder, "run" or "sweep".

    Raises:
      UserError: the folder holds something else, or cannot be written, or another
        process trains in it.
    """
    if header is None:
        read_header(folder, kind)
    else:
        _check_vacant(folder)
        make(folder)
    lock = _lock(folder)
    if lock is None:
        raise UserError(
            f"another process trains in {folder}: wait for its end or stop it, then "
            "go on with --resume; or name another folder with --out"
        )
    try:
        if header is not None:
            _check_vacant(folder)  # Another process may have been faster.
            write(folder / HEADER, {"format": FORMAT, **header})
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[bool]:
    """Makes a folder if necessary and locks it, unless another process has.

    Yields whether this process has the lock.

    Raises:
      UserError: the folder cannot be written.
    """
    make(folder)
    lock = _lock(folder)
    try:
        yield lock is not None
    finally:
        if lock:
            lock.release()


def _lock(folder: Path) -> FileLock | None:
    """Locks a folder; None if another process has.

    The system unlocks it when the process ends in any way.
    """
    file = folder / _LOCK
    lock = FileLock(file, timeout=0)
    with writing(folder):
        if file.is_symlink() or (file.exists() and not file.is_file()):
            raise UserError(f"{file} is not a file: delete it, then try again")
        try:
            lock.acquire()
        except Timeout:
            return None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
    return lock


def _check_vacant(folder: Path) -> None:
    """Raises `UserError` if a folder contains more than an interrupted start."""
    with writing(folder):
        others = folder.exists() and (
            not folder.is_dir()
            or {path.name for path in folder.iterdir()} - {_LOCK, f".{HEADER}"}
        )
    if others:
        what = "another run" if (folder / HEADER).exists() else "something else"
        raise UserError(
            f"{folder} holds {what}: name another folder with --out, or continue "
            "the run there with --resume"
        )


def make(folder: Path) -> None:
    """Creates a folder if it does not exist; `UserError` if this fails."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Writes JSON completely or not at all; `UserError` if this fails."""
    temporary = path.with_name(f".{path.name}")
    try:
        with writing(path):
            temporary.unlink(missing_ok=True)  # A link would lead elsewhere.
            temporary.write_text(json.dumps(content, indent=1) + "\n")
            temporary.rename(path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def read_header(folder: Path, kind: str = "run") -> dict[str, Any]:
    """The header of a run, or of a sweep.

    Raises:
      UserError: there is none, one of another format, or of the other kind.
    """
    # Unlike a Path's, it is False where one has no right to look.
    if not os.path.exists(folder / HEADER):  # noqa: PTH110
        raise UserError(f"{folder} holds no {kind}: there is no {HEADER} to be read")
    header = document(folder / HEADER)
    check_format(folder, header)
    found = header.get("kind", "run")
    if found != kind:
        raise UserError(f"{folder} holds a {found}, not a {kind}")
    with reading(folder / HEADER):
        if not isinstance(header["settings"]["method"], str):
            raise ValueError("method is no name")
    return header


def check_format(folder: Path, header: Any) -> None:
    """Raises `UserError` if a folder's header is of another format."""
    found = header.get("format") if isinstance(header, dict) else None
    if found != FORMAT:
        with telling_version(folder, header):
            raise UserError(f"it has format {found}, not {FORMAT}")


@contextlib.contextmanager
def telling_version(folder: Path, header: Any) -> Iterator[None]:
    """A `UserError` inside also names the version that wrote a folder, if another."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{folder}: {error}{_other_version(header)}") from error


def _other_version(header: Any) -> str:
    """What to say of a folder that another version wrote, by its header."""
    try:
        how = header["provenance"]
        version, commit = how["versions"]["rewire_jax"], how["commit"]
    except (KeyError, TypeError):
        version, commit = "of an unknown version", "unknown"
    if version == __version__:
        return ""
    return (
        f"; it was written by rewire_jax {version}, commit {commit}, not {__version__}:"
        " use that version, or train in another folder"
    )


def kind(folder: Path) -> str:
    """What a folder holds: "run", also where that cannot be told, or "sweep"."""
    try:
        return document(folder / HEADER).get("kind", "run")
    except (UserError, AttributeError):
        return "run"


def compare(folder: Path, settings: Settings, kind: str = "run") -> None:
    """Raises `UserError` if a folder's run or sweep has other settings."""

    def flat(data: dict[str, Any]) -> dict[str, Any]:
        rows: dict[str, Any] = {}
        for name, value in data.items():
            rows |= flat(value) if isinstance(value, dict) else {name: value}
        return rows

    header = read_header(folder, kind)
    saved = header["settings"]
    if saved.get("method") == settings.method:
        # What the run's version did not have was as it is by default.
        with telling_version(folder, header):
            saved = to_json(from_json(saved, type(settings.options)))
    then = flat(saved)
    now = flat(to_json(settings))
    changed = [n for n in {**then, **now} if then.get(n) != now.get(n)]
    if changed:
        first = changed[0]
        raise UserError(
            f"{folder} was started with other settings: {flag(first)} was "
            f"{then.get(first)}, not {now.get(first)}; drop it or name another --out"
        )


def append(folder: Path, table: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Adds rows to a table; `UserError` if it is a link or cannot be written."""
    refuse_link(folder / table)
    text = "".join(json.dumps(row) + "\n" for row in rows)
    with writing(folder / table), (folder / table).open("a") as file:
        file.write(text)


def marks(folder: Path) -> dict[str, Mark]:
    """Where each table ends, to come back to with `cut`."""
    found: dict[str, Mark] = {}
    for table in TABLES:
        held = _bytes(folder / table)
        found[table] = len(held), _digest(held)
    return found


def changed(folder: Path, marks: Mapping[str, Mark]) -> Path | None:
    """A table that does not begin as it was when `marks` were taken, None if all do."""
    for table, mark in marks.items():
        length, digest = _parts(mark)
        held = _bytes(folder / table)[:length]
        if len(held) < length or (digest and _digest(held) != digest):
            return folder / table
    return None


def longer(folder: Path, marks: Mapping[str, Mark]) -> dict[str, bytes]:
    """The tables that were written to after `marks` were taken, as they are."""
    held = {table: _bytes(folder / table) for table in TABLES}
    return {t: x for t, x in held.items() if len(x) > _parts(marks.get(t, 0))[0]}


def copies(folder: Path, marks: Mapping[str, Mark]) -> list[Path]:
    """Copies each table that `cut` would shorten, under a name with the time.

    Raises:
      UserError: a copy cannot be written.
    """
    made = []
    now = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    for table, held in longer(folder, marks).items():
        copy = folder / f"{table}.{now}"
        with writing(copy):
            copy.write_bytes(held)
        made.append(copy)
    return made


def check_own(path: Path) -> None:
    """Raises `UserError` if a folder that is to be written in is a link or a file."""
    refuse_link(path)
    if path.exists() and not path.is_dir():
        raise UserError(f"{path} is not a folder of this run: move it away")


def refuse_link(path: Path) -> None:
    """Raises `UserError` for a link of any kind: nothing outside is written."""
    if path.is_symlink():
        raise UserError(f"{path} is a link: replace it by what it names")
    if path.is_file() and path.stat().st_nlink > 1:
        raise UserError(f"{path} has another name elsewhere: replace it by a copy")


def cut(folder: Path, marks: Mapping[str, Mark]) -> None:
    """Forgets what was written after `marks` were taken; of other tables everything.

    Raises:
      UserError: a table cannot be written.
    """
    for table in TABLES:
        path = folder / table
        length, _ = _parts(marks.get(table, 0))
        with writing(path):
            refuse_link(path)
            if path.exists() and path.stat().st_size > length:
                os.truncate(path, length)


def _parts(mark: Mark) -> tuple[int, str]:
    return (mark, "") if isinstance(mark, int) else (mark[0], mark[1])


def _bytes(path: Path) -> bytes:
    return raw(path) if path.exists() else b""


def _digest(held: bytes) -> str:
    return hashlib.sha256(held).hexdigest()
