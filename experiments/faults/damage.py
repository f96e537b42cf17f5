"""Damage to what a run has written: checkpoints, and tables of results."""

import random
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import rewire_jax
from experiments.faults import base, kills
from experiments.faults.base import SETTINGS, TRAIN, Case, Kind, Outcome
from experiments.faults.kills import SWEEP

_SEED = 11
_TASKS = SETTINGS["tasks"]
_EVALUATE = ("--episodes", "4", "--json")
_MIDDLE = "task-001-step-0000020"
Change = Callable[[bytes, int, int], bytes]
"""From what a file holds, a place in it and a bit of a byte, to what it holds then."""


def halfway(beside: Path) -> Path:
    """A run killed in its second task, after a checkpoint; to be left as it is."""
    folder = beside.parent / "halfway"
    if not folder.exists():
        made = folder.with_suffix(".part")
        moment = kills.Moment(_MIDDLE, partial(kills.kept, _MIDDLE), 0.0)
        wrong = kills.kill(made, moment, *TRAIN, "--out", made)
        if wrong:
            raise RuntimeError(wrong)
        made.rename(folder)
    return folder


def truncate(held: bytes, at: int, bit: int) -> bytes:
    """The first bytes alone."""
    return held[:at]


def flip(held: bytes, at: int, bit: int) -> bytes:
    """The same with one bit of one byte another."""
    return held[:at] + bytes([held[at] ^ 1 << bit]) + held[at + 1 :]


def damage(checkpoint: Path, change: Change, number: int) -> str:
    """Changes a file of a checkpoint at a random place; says which."""
    draw = random.Random(f"{_SEED} {change.__name__} {number}")
    files = sorted(f for f in checkpoint.rglob("*") if f.is_file() and f.stat().st_size)
    file = draw.choice(files)
    held = file.read_bytes()
    file.write_bytes(change(held, draw.randrange(len(held)), draw.randrange(8)))
    return file.relative_to(checkpoint).as_posix()


def resumed(folder: Path, whole: Path, *told: str) -> str:
    """What is wrong if a run is resumed, which should say this; "" if nothing is."""
    ran = base.run(*TRAIN, "--out", folder, "--resume")
    silent = [word for word in told if word not in ran.err]
    return base.first(
        base.failed(ran),
        f"it does not say {silent}: {ran.err}" if silent else "",
        base.different(folder, whole),
    )


def play(folder: Path, stage: int) -> np.ndarray:
    """What a policy of the run does, loaded as a library's user loads it."""
    policy = rewire_jax.load_policy(folder, task=stage, seed=1, stage=stage)
    return np.asarray(policy(jnp.linspace(-1, 1, 2)))


def refused(folder: Path, whole: Path, stage: int, file: str) -> str:
    """What is wrong with how a damaged policy is met: told, or not needed."""
    name = f"task-{stage + 1:03d}"
    words = ("--stage", str(stage), *_EVALUATE)
    ran = base.run("evaluate", folder, *words)
    if file.startswith("policy/") or "/" not in file:
        wrong = base.complaint(ran, name, file, "delete it", "--resume")
    else:  # critics and counts are not read to play
        there = base.run("evaluate", whole, *words)
        wrong = "" if ran.out == there.out else f"another evaluation: {ran.out}"
    try:
        same = np.array_equal(play(folder, stage), play(whole, stage))
        return wrong or ("" if same else "another policy")
    except rewire_jax.UserError as error:
        return wrong or ("" if file in str(error) else f"it does not say {file}")


def middle(change: Change, number: int, place: Path) -> Outcome:
    """The newest checkpoint of an unfinished run: the one before is taken instead."""
    whole = base.unbroken(place, *TRAIN)
    folder = Path(shutil.copytree(halfway(place), place / "run"))
    file = damage(folder / "checkpoints" / _MIDDLE, change, number)
    wrong = resumed(folder, whole, _MIDDLE, file, "falling back")
    return Outcome("", wrong, base.lost(base.results(whole), folder))


def finished(change: Change, number: int, place: Path) -> Outcome:
    """What is kept of a task: deleted as the line says, it is trained again."""
    whole = base.unbroken(place, *TRAIN)
    folder = Path(shutil.copytree(whole, place / "run"))
    stage = number % _TASKS
    kept = [folder / "checkpoints" / f"task-{n + 1:03d}" for n in range(_TASKS)]
    file = damage(kept[stage], change, number)
    wrong = refused(folder, whole, stage, file)
    told: tuple[str, ...] = (kept[-1].name, file, "falling back")
    if stage < _TASKS - 1:
        told = ()
        for path in kept[stage:]:
            shutil.rmtree(path)
    wrong = base.first(wrong, resumed(folder, whole, *told))
    return Outcome("", wrong, base.lost(base.results(whole), folder))


def sweep(change: Change, number: int, place: Path) -> Outcome:
    """What a sweep's next task begins from: deleted as told, it is trained again."""
    whole = base.unbroken(place, *SWEEP)
    folder = Path(shutil.copytree(whole, place / "sweep"))
    for later in folder.glob("task-00[12]"):
        shutil.rmtree(later)
    batch = folder / "task-000" / "batch-000"
    file = damage(batch / "checkpoints" / "task-001", change, number)
    command = (*SWEEP, "--out", str(folder), "--resume")
    ran = base.run(*command)
    wrong = base.complaint(ran, file, f"delete {batch}")
    shutil.rmtree(batch)
    again = base.run(*command)
    wrong = base.first(wrong, base.failed(again), base.different(folder, whole))
    return Outcome(ran.said, wrong, base.lost(base.results(whole), folder))


def cut_last(lines: list[str]) -> str:
    """The last line is cut in its middle."""
    return "\n".join(lines[:-1]) + "\n" + lines[-1][: len(lines[-1]) // 2]


def cut_middle(lines: list[str]) -> str:
    """The file ends within a line in its middle."""
    return cut_last(lines[: len(lines) // 2])


def empty(lines: list[str]) -> str:
    """Nothing is left."""
    return ""


def foreign(lines: list[str]) -> str:
    """A line of something else lies between the others."""
    middle = len(lines) // 2
    return "\n".join([*lines[:middle], "not one of ours", *lines[middle:], ""])


def twice(lines: list[str]) -> str:
    """The first line lies, changed, where the second was."""
    return "\n".join([lines[0], lines[0].replace("0", "1"), *lines[2:], ""])


def table(
    name: str, change: Callable[[list[str]], str], broken: bool, place: Path
) -> Outcome:
    """A table is damaged: a report tells, or works; resumed, the run is mended."""
    whole = base.unbroken(place, *TRAIN)
    source = halfway(place) if broken else whole
    folder = Path(shutil.copytree(source, place / "run"))
    path = folder / name
    path.write_text(change(path.read_text().splitlines()))
    ran = base.run("report", folder, "--out", place / "report")
    wrong = base.complaint(ran, name) if ran.status else ""
    wrong = base.first(wrong, resumed(folder, whole))
    again = base.run("report", folder, "--out", place / "report")
    wrong = base.first(wrong, base.failed(again))
    said = ran.said if ran.status else ""
    return Outcome(said, wrong, base.lost(base.results(whole), folder))


_CUTS: dict[str, tuple[Callable[[list[str]], str], ...]] = {
    "results.jsonl": (cut_last, cut_middle, empty, foreign, twice),
    "training.jsonl": (cut_last, empty, foreign),
    "timing.jsonl": (cut_last, empty),
}
_CUTS_HALFWAY: dict[str, tuple[Callable[[list[str]], str], ...]] = {
    "results.jsonl": (cut_last, foreign),
    "training.jsonl": (cut_middle,),
}


def _tables(broken: bool) -> list[Case]:
    when = "unfinished" if broken else "finished"
    cuts = _CUTS_HALFWAY if broken else _CUTS
    return [
        Case(f"{name} {how.__name__}, {when}", partial(table, name, how, broken))
        for name, some in cuts.items()
        for how in some
    ]


KINDS = (
    Kind(
        "damage",
        "a checkpoint is truncated, or a bit of it flipped",
        tuple(
            Case(f"{kind.__name__}, {change.__name__} {n}", partial(kind, change, n))
            for change in (truncate, flip)
            for n, kind in enumerate([middle, finished] * 10 + [sweep])
        ),
    ),
    Kind(
        "table",
        "a result file is cut in a line, emptied, or has foreign lines",
        (*_tables(False), *_tables(True)),
    ),
)
