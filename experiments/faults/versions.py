"""Run folders as older and newer versions of rewire_jax write them.

They are made from a fresh one: what a version did not know is taken away, as the
history of this one's files tells, and what a later one may add is put in.
"""

import hashlib
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import rewire_jax
from experiments.faults import base, damage
from experiments.faults.base import TRAIN, Case, Kind, Outcome
from rewire_jax.storage.run_folder import HEADER, TABLES

OTHER = "98.7.6"
_EPISODES = ("--episodes", "4", "--json")
Change = Callable[[Path], None]


def rewrite(path: Path, change: Callable[[Any], None]) -> None:
    """Changes what a JSON file holds."""
    held = json.loads(path.read_text())
    change(held)
    path.write_text(json.dumps(held, indent=1))


def header(change: Callable[[Any], None], folder: Path) -> None:
    """Changes the header of a run that another version wrote."""

    def edit(held: Any) -> None:
        held["provenance"]["versions"]["rewire_jax"] = OTHER
        change(held)

    rewrite(folder / HEADER, edit)


def checkpoints(change: Callable[[Any], None], folder: Path) -> None:
    """Changes what the checkpoints say of themselves, in a way that looks whole."""

    def edit(held: Any) -> None:
        content = held["content"]
        content["version"] = OTHER
        change(held)
        text = json.dumps(content).encode()
        held["sha256"] = hashlib.sha256(text).hexdigest()

    for path in folder.glob("checkpoints/*/manifest.json"):
        rewrite(path, edit)


def fewer_settings(held: Any) -> None:
    """As before pink noise, overlap, turns of updates and Meta-World's rewards."""
    del held["settings"]["sac"]["noise_color"]
    for name in ("overlap", "update_every", "reward"):
        del held["settings"][name]


def no_version(held: Any) -> None:
    """As before the version was recorded."""
    del held["provenance"]["versions"]["rewire_jax"]


def lengths(held: Any) -> None:
    """As before checkpoints held digests of the tables, and their version."""
    tables = held["content"]["metadata"]["tables"]
    held["content"]["metadata"]["tables"] = {t: mark[0] for t, mark in tables.items()}
    del held["content"]["version"]


def fewer_columns(folder: Path) -> None:
    """As before members were numbered and memory was recorded."""
    for table in TABLES:
        path = folder / table
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        for row in rows:
            row.pop("member", None)
            row.pop("memory", None)
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def unknown_setting(held: Any) -> None:
    """As if a later version had one more."""
    held["settings"]["sac"]["lookahead"] = 3


def unknown_option(held: Any) -> None:
    """As if a later version of the method had one more."""
    held["settings"]["options"]["lookahead"] = 3


def missing_setting(held: Any) -> None:
    """As if it had been called otherwise, or been a constant."""
    del held["settings"]["paper_interactions"]


def other_format(held: Any) -> None:
    """As if files had changed altogether."""
    held["format"] += 1


def other_leaf(held: Any) -> None:
    """As if policies had been made of other arrays."""
    items = held["content"]["items"]
    for name in {"policy", "state"} & items.keys():
        items[name][0] = f"{name}.trunk float32[2,9,9]"


def works(folder: Path, whole: Path) -> str:
    """What is wrong, where all commands should do as with a folder of today."""
    resumed = base.run(*TRAIN, "--out", folder, "--resume")
    played = base.run("evaluate", folder, *_EPISODES)
    there = base.run("evaluate", whole, *_EPISODES)
    told = base.run("report", folder, "--out", folder.with_name("report"))
    return base.first(
        base.failed(resumed),
        base.different(folder, whole),
        base.failed(played),
        "" if played.out == there.out else "another evaluation",
        base.failed(told),
        _load(folder),
    )


def _load(folder: Path) -> str:
    """The line in which loading a policy ends, "" if it is loaded."""
    try:
        rewire_jax.load_policy(folder, task=0)
    except rewire_jax.UserError as error:
        return str(error)
    return ""


def older(changes: tuple[Change, ...], half: bool, place: Path) -> Outcome:
    """A folder of an older version serves as one of today does.

    Args:
      changes: that make it older.
      half: whether the run was killed in its middle.
      place: a new folder.
    """
    whole, folder = base.unbroken(place, *TRAIN), place / "run"
    shutil.copytree(damage.halfway(place) if half else whole, folder)
    for change in changes:
        change(folder)
    wrong = works(folder, whole)
    return Outcome("", wrong, base.lost(base.results(whole), folder))


def report_alone(place: Path) -> Outcome:
    """Rows with fewer columns are reported on like others."""
    whole, folder = base.unbroken(place, *TRAIN), place / "run"
    shutil.copytree(whole, folder)
    fewer_columns(folder)
    made = []
    for each in (whole, folder):
        ran = base.run("report", each, "--out", place / "report")
        made.append((ran.status, (place / "report" / "tasks.csv").read_text()))
    same = made[0] == made[1] and not made[0][0]
    return Outcome("", "" if same else f"another report: {made}", 0)


def refused(change: Change, reports: bool, place: Path) -> Outcome:
    """Each command says in a line whose folder it is, and leaves it as it is.

    Args:
      change: that makes it that of another version.
      reports: whether a report should be made all the same: it needs less.
      place: a new folder.
    """
    whole, folder = base.unbroken(place, *TRAIN), place / "run"
    shutil.copytree(whole, folder)
    change(folder)
    before = base.contents(folder)
    resumed = base.run(*TRAIN, "--out", folder, "--resume")
    told = base.run("report", folder, "--out", place / "report")
    wrong = base.first(
        base.complaint(resumed, OTHER),
        base.complaint(base.run("evaluate", folder, *_EPISODES), OTHER),
        base.failed(told) if reports else base.complaint(told, OTHER),
        "" if OTHER in _load(folder) else f"load_policy: {_load(folder)}",
        "the folder was changed" if base.contents(folder) != before else "",
    )
    return Outcome(resumed.said, wrong, base.lost(base.results(whole), folder))


def _cases() -> list[Case]:
    less = partial(header, fewer_settings)
    unnamed = partial(header, no_version)
    marks = partial(checkpoints, lengths)
    old: dict[str, tuple[tuple[Change, ...], bool]] = {
        "older: fewer settings": ((less,), False),
        "older: no version": ((unnamed,), False),
        "older: checkpoints without digests of tables": ((marks,), False),
        "older: all of these, stopped": ((less, unnamed, marks), True),
    }
    cases = [Case(name, partial(older, *what)) for name, what in old.items()]
    cases.append(Case("older: fewer columns", report_alone))
    new: dict[str, tuple[Change, bool]] = {
        "other: a setting that is unknown": (partial(header, unknown_setting), True),
        "other: an option that is unknown": (partial(header, unknown_option), True),
        "other: a setting is missing": (partial(header, missing_setting), True),
        "other: format of the folder": (partial(header, other_format), False),
        "other: format of checkpoints": (partial(checkpoints, other_format), True),
        "other: arrays of a policy": (partial(checkpoints, other_leaf), True),
    }
    cases += [Case(name, partial(refused, *what)) for name, what in new.items()]
    return cases


KINDS = (
    Kind(
        "versions",
        "a run folder of another version: it serves, or its version is named",
        tuple(_cases()),
    ),
)
