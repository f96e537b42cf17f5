"""The files of a run: a header, and tables to which rows are appended.

settings.json     settings, task names, network sizes, provenance
results.jsonl     a row for each evaluation: stage, task, seed
training.jsonl    a row for each progress report and seed
timing.jsonl      a row for each progress report: wall-clock seconds
checkpoints/      `task-003` after three tasks, `task-003-step-…` in the next
"""

import contextlib
import importlib.metadata
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

from rewire_jax import config
from rewire_jax.errors import UserError
from rewire_jax.version import __version__

FORMAT = 1
HEADER = "settings.json"
TABLES = ("results.jsonl", "training.jsonl", "timing.jsonl")
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "brax", "mujoco", "orbax-checkpoint")


def provenance() -> dict[str, Any]:
    """What a result must be traced back by: command, commit, versions, device."""
    root = Path(__file__).parent.parent
    commit = "unknown"
    # Installed, it may stand in the repository of something else.
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


def create(folder: Path, header: Mapping[str, Any]) -> None:
    """Makes a run folder.

    Raises:
      UserError: the folder holds something, or cannot be written.
    """
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            what = "another run" if (folder / HEADER).exists() else "something else"
            raise UserError(
                f"{folder} holds {what}: name another folder with --out, or continue "
                "the run there with --resume"
            )
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error}") from error
    make(folder)
    write(folder / HEADER, {"format": FORMAT, **header})


def make(folder: Path) -> None:
    """Makes a folder that may be there; `UserError` if it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}") from error


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Writes JSON, all of it or nothing; `UserError` if it cannot be written."""
    try:
        temporary = path.with_name(f".{path.name}")
        temporary.write_text(json.dumps(content, indent=1) + "\n")
        temporary.rename(path)
    except OSError as error:
        raise UserError(f"cannot write to {path.parent}: {error}") from error


def read_header(folder: Path, kind: str = "run") -> dict[str, Any]:
    """The header of a run, or of a sweep.

    Raises:
      UserError: there is none, one of another format, or of the other kind.
    """
    try:
        header = json.loads((folder / HEADER).read_text())
    except OSError as error:
        raise UserError(f"{folder} holds no {kind}: {HEADER} cannot be read") from error
    except ValueError as error:
        raise UserError(f"{folder / HEADER} is damaged: {error}") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise UserError(f"{folder} was not written by this version of rewire_jax")
    found = header.get("kind", "run")
    if found != kind:
        raise UserError(f"{folder} holds a {found}, not a {kind}")
    return header


def kind(folder: Path) -> str:
    """What a folder holds: "run", also where that cannot be told, or "sweep"."""
    try:
        return json.loads((folder / HEADER).read_text()).get("kind", "run")
    except (OSError, ValueError, AttributeError):
        return "run"


def compare(folder: Path, settings: config.Settings, kind: str = "run") -> None:
    """Raises `UserError` if a folder's run or sweep has other settings."""

    def flat(data: dict[str, Any]) -> dict[str, Any]:
        rows: dict[str, Any] = {}
        for name, value in data.items():
            rows |= flat(value) if isinstance(value, dict) else {name: value}
        return rows

    saved = read_header(folder, kind)["settings"]
    if saved.get("method") == settings.method:
        # What the run's version did not have was as it is by default.
        saved = config.to_json(config.from_json(saved, type(settings.options)))
    then = flat(saved)
    now = flat(config.to_json(settings))
    changed = [n for n in {**then, **now} if then.get(n) != now.get(n)]
    if changed:
        first = changed[0]
        raise UserError(
            f"{folder} was started with other settings: {config.flag(first)} was "
            f"{then.get(first)}, not {now.get(first)}; drop it or name another --out"
        )


def append(folder: Path, table: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Adds rows to a table; `UserError` if they cannot be written."""
    text = "".join(json.dumps(row) + "\n" for row in rows)
    try:
        with (folder / table).open("a") as file:
            file.write(text)
    except OSError as error:
        raise UserError(f"cannot write to {folder / table}: {error}") from error


def lengths(folder: Path) -> dict[str, int]:
    """Bytes in each table, to come back to with `cut`."""
    paths = {table: folder / table for table in TABLES}
    return {t: path.stat().st_size if path.exists() else 0 for t, path in paths.items()}


def cut(folder: Path, lengths: Mapping[str, int]) -> None:
    """Forgets what was written after `lengths` was taken.

    Raises:
      UserError: a table has lost rows since then.
    """
    for table, length in lengths.items():
        path = folder / table
        have = path.stat().st_size if path.exists() else 0
        if have < length:
            raise UserError(f"{path} has lost rows: restore it or start a new run")
        if have > length:
            with path.open("r+b") as file:
                file.truncate(length)
