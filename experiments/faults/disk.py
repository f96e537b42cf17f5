"""Disks that are full, and folders that cannot be written."""

import os
import random
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from experiments.faults import base, damage, kills
from experiments.faults.base import TRAIN, Case, Impossible, Kind, Outcome
from experiments.faults.kills import Moment

_SEED = 13
_PAGE = 4096
_ROOM = 1 << 26


@contextmanager
def small_disk(place: Path, size: int) -> Iterator[Path]:
    """A file system with room for so many bytes, in memory.

    Raises:
      Impossible: it takes root's rights, which this process lacks.
    """
    place.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={size}"]
    mounted = subprocess.run(
        ["mount", *options, "tmpfs", str(place)], capture_output=True, check=False
    )
    if mounted.returncode:
        raise Impossible("a small file system can be mounted by root alone")
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


def free(place: Path) -> None:
    """Makes room on a small disk."""
    options = f"remount,size={2 * _ROOM}"
    subprocess.run(["mount", "-o", options, str(place)], check=True)


def taken(folder: Path) -> int:
    """Bytes that a folder takes on such a disk."""
    sizes = (f.stat().st_size for f in folder.rglob("*") if f.is_file())
    return sum(-(-size // _PAGE) * _PAGE for size in sizes)


def fill(place: Path) -> None:
    """Leaves no room on a small disk."""
    with (place / "ballast").open("wb", buffering=0) as file:
        try:
            while file.write(bytes(_PAGE)):
                pass
        except OSError:
            return


def full(share: float, place: Path) -> Outcome:
    """A disk with room for a share of what a run leaves; it takes more."""
    whole = base.unbroken(place, *TRAIN)
    with small_disk(place / "disk", int(share * taken(whole))) as disk:
        folder = disk / "run"
        ran = base.run(*TRAIN, "--out", folder)
        return after(ran, disk, folder, whole)


def filled(moment: Moment, place: Path) -> Outcome:
    """A disk that someone else fills while a run goes on."""
    whole = base.unbroken(place, *TRAIN)
    with small_disk(place / "disk", _ROOM) as disk:
        folder = disk / "run"
        process = base.start(*TRAIN, "--out", folder)
        kills.wait(process, folder, moment)
        fill(disk)
        return after(base.end(process), disk, folder, whole)


def after(ran: base.Ran, disk: Path, folder: Path, whole: Path) -> Outcome:
    """What came of a run on a full disk, once there is room again."""
    before = base.results(folder) & base.results(whole)
    free(disk)
    resume = ["--resume"] if (folder / "settings.json").exists() else []
    again = base.run(*TRAIN, "--out", folder, *resume)
    told = base.complaint(ran, str(folder), "free space", "--resume")
    wrong = base.first(
        told if ran.status else "",  # it may have had enough room to its end
        base.failed(again),
        base.different(folder, whole),
    )
    said = ran.said if ran.status else ""
    return Outcome(said, wrong, base.lost(before, folder))


def full_of_reports(share: float, place: Path) -> Outcome:
    """The disk is full while a report is written."""
    whole = base.unbroken(place, *TRAIN)
    there = place / "there"
    wrong = base.failed(base.run("report", whole, "--out", there))
    with small_disk(place / "disk", int(share * taken(there))) as disk:
        out = disk / "report"
        ran = base.run("report", whole, "--out", out)
        free(disk)
        wrong = base.first(
            wrong,
            base.complaint(ran, str(out), "free space"),
            base.failed(base.run("report", whole, "--out", out)),
        )
        names = [{f.name for f in each.iterdir()} for each in (there, out)]
        if names[0] != names[1]:
            wrong = wrong or f"files are {names[1]}, not {names[0]}"
        return Outcome(ran.said, wrong, 0)


def full_cache(size: int, place: Path) -> Outcome:
    """What is compiled finds no room: the run goes on."""
    whole = base.unbroken(place, *TRAIN)
    folder = place / "run"
    with small_disk(place / "disk", size) as disk:
        # Twice: what was half written is read by the second.
        ran = [
            base.run(*TRAIN, "--cache", disk / "cache", "--out", each)
            for each in (place / "first", folder)
        ]
    outcome = _went_on(ran[1], folder, whole)
    return outcome._replace(wrong=base.first(base.failed(ran[0]), outcome.wrong))


def _went_on(ran: base.Ran, folder: Path, whole: Path) -> Outcome:
    """What a run that goes on without its cache says and gives."""
    lines = [line for line in ran.err.splitlines() if "finished in" not in line]
    wrong = base.first(
        base.failed(ran),
        f"{len(lines)} lines, not one: {ran.err}" if len(lines) > 1 else "",
        base.different(folder, whole),
    )
    return Outcome("".join(lines), wrong, base.lost(base.results(whole), folder))


def unwritable(folder: Path, *arguments: str | Path) -> base.Ran:
    """Runs a command to which all that a folder holds is read-only.

    Raises:
      Impossible: root, whom modes do not stop, may not mount it read-only either.
    """
    if os.geteuid():
        files = [folder, *folder.rglob("*")]
        for file in files:
            file.chmod(file.stat().st_mode & ~0o222)
        try:
            return base.run(*arguments)
        finally:
            for file in files:
                file.chmod(file.stat().st_mode | 0o200)
    bind = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && exec "$@"'
    inside = ["unshare", "--mount", "sh", "-c", bind, str(folder)]
    if subprocess.run([*inside, "true"], capture_output=True, check=False).returncode:
        raise Impossible("a folder can be mounted read-only by root alone")
    return base.run(*arguments, before=inside)


def locked(arguments: Sequence[str], told: Sequence[str], place: Path) -> Outcome:
    """A command on a folder that cannot be written, which it should tell.

    Args:
      arguments: with {run}, {half} and {here} for a finished run, an unfinished one,
        and the empty folder beside them.
      told: words that its line has; none if it should work.
      place: a new folder.
    """
    whole = base.unbroken(place, *TRAIN)
    box = place / "box"
    box.mkdir()
    names = {name: box / name for name in ("run", "half", "here")}
    shutil.copytree(whole, names["run"])
    shutil.copytree(damage.halfway(place), names["half"])
    names["here"].mkdir()
    before = {name: base.results(path) for name, path in names.items()}
    ran = unwritable(box, *(word.format(**names) for word in arguments))
    wrong = base.complaint(ran, *told) if told else base.failed(ran)
    left = sum(base.lost(before[name], path) for name, path in names.items())
    wrong = base.first(wrong, damage.resumed(names["half"], whole))
    return Outcome(ran.said if told else "", wrong, left)


def locked_cache(place: Path) -> Outcome:
    """The folder of what is compiled cannot be written: the run goes on."""
    whole = base.unbroken(place, *TRAIN)
    cache, folder = place / "cache", place / "run"
    cache.mkdir()
    ran = unwritable(cache, *TRAIN, "--cache", cache, "--out", folder)
    return _went_on(ran, folder, whole)


def _shares(count: int, seed: int) -> list[float]:
    """Random shares of a disk, one in each of as many parts."""
    draw = random.Random(seed)
    return [(n + draw.random()) / count for n in range(count)]


_LOCKED: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "train": ((*TRAIN, "--out", "{here}"), ("here", "make it writable")),
    "train, a new folder": ((*TRAIN, "--out", "{here}/run"), ("here", "writable")),
    "train --resume": ((*TRAIN, "--out", "{half}", "--resume"), ("half", "writable")),
    "report": (("report", "{run}", "--out", "{here}"), ("here", "writable")),
    "evaluate": (("evaluate", "{run}", "--episodes", "2"), ()),
}

KINDS = (
    Kind(
        "full",
        "the disk is full while a run writes, or a report, or what is compiled",
        (
            *(Case(f"run, {s:.0%}", partial(full, s)) for s in _shares(4, _SEED)),
            *(
                Case(f"run, at {moment.name}", partial(filled, moment))
                for moment, *_ in kills.moments(_SEED)[:10]
            ),
            *(
                Case(f"report, {s:.0%}", partial(full_of_reports, s))
                for s in _shares(2, _SEED + 1)
            ),
            *(
                Case(f"compiled, {size} bytes", partial(full_cache, size))
                for size in (8 * _PAGE, 100 * _PAGE)
            ),
        ),
    ),
    Kind(
        "read-only",
        "a folder cannot be written",
        (
            *(Case(name, partial(locked, *how)) for name, how in _LOCKED.items()),
            Case("what is compiled", locked_cache),
        ),
    ),
)
