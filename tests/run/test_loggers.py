import json
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from tensorboardX.proto.event_pb2 import Event, SessionLog

from rewire_jax.cli import main
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.run import loggers, sweep, train_run
from rewire_jax.run.loggers import Kind, Logger, Loggers, Subject
from rewire_jax.run.progress import Progress
from tests.tiny import flags, tiny

Numbers = dict[tuple[str, int], list[float]]
BOTH = ("tensorboard", "wandb")


class FakeRun:
    """A run at Weights & Biases, in memory."""

    def __init__(self, **options: Any):
        self.options = options
        self.rows: list[dict[str, float]] = []
        self.axes: dict[str, str] = {}
        self.finished = 0

    def define_metric(self, name: str, step_metric: str = "", hidden: bool = False):
        self.axes[name] = step_metric

    def log(self, row: dict[str, float]) -> None:
        self.rows.append(row)

    def finish(self) -> None:
        self.finished += 1


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[FakeRun]:
    """All runs that a stand-in for the wandb package opened."""
    opened: list[FakeRun] = []

    def init(**options: Any) -> FakeRun:
        opened.append(FakeRun(**options))
        return opened[-1]

    fake = ModuleType("wandb")
    fake.__spec__ = SimpleNamespace(name="wandb")  # type: ignore[assignment]
    fake.init = init  # type: ignore[attr-defined]
    fake.login = lambda prompt: False  # type: ignore[attr-defined]
    fake.Settings = dict  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    return opened


def events(folder: Path) -> Iterator[Event]:
    """All events of a log, in the order of its files."""
    for path in sorted(folder.iterdir()):
        data = path.read_bytes()
        while data:
            size = int.from_bytes(data[:8], "little")
            yield Event.FromString(data[12 : 12 + size])
            data = data[16 + size :]


def shown(folder: Path) -> Numbers:
    """What TensorBoard shows: a session's start hides what is not before its step."""
    numbers: Numbers = defaultdict(list)
    for event in events(folder):
        if event.session_log.status == SessionLog.START:
            for name, step in list(numbers):
                if step >= event.step:
                    del numbers[name, step]
        for value in event.summary.value:
            numbers[value.tag, event.step].append(value.simple_value)
    return numbers


def logged(runs: list[FakeRun]) -> Numbers:
    """What the runs were given, all of one id."""
    assert len({run.options["id"] for run in runs}) == 1
    numbers: Numbers = defaultdict(list)
    for row in [row for run in runs for row in run.rows]:
        step = row.pop("interactions")
        for name, value in row.items():
            numbers[name, int(step)].append(value)
    return numbers


def expected(tables: list[Path], member: int, interactions: int) -> Numbers:
    """The same from the tables."""
    numbers: Numbers = {}
    places = {"stage", "member", "seed", "interactions"}
    for table in tables:
        for row in map(json.loads, (table / "training.jsonl").open()):
            step = row["stage"] * interactions + row["interactions"]
            for name in row.keys() - places:
                if row["member"] == member and row[name] is not None:
                    numbers[f"training/{name}", step] = [row[name]]
        for row in map(json.loads, (table / "results.jsonl").open()):
            step = row["interactions"]["training"]
            for name in {"return", "success", "success_last", "choice"} & row.keys():
                tag = f"evaluation/{name}/{row['task']:02d}-{row['name']}"
                if row["member"] == member:
                    numbers[tag, step] = [row[name]]
    return numbers


def same(ours: Numbers, theirs: Numbers) -> None:
    assert ours.keys() == theirs.keys()
    for key, values in theirs.items():
        assert ours[key] == pytest.approx(values, rel=1e-6)


class Killed(Exception):
    pass


def killing(monkeypatch: pytest.MonkeyPatch, name: str, times: int) -> None:
    """Ends a run, once, as a kill does after so many calls of a step of its."""
    called = getattr(train_run.Run, name)
    calls = []

    def counting(self, *rest):
        result = called(self, *rest)
        calls.append(None)
        if len(calls) == times:
            raise Killed
        return result

    monkeypatch.setattr(train_run.Run, name, counting)


# In the middle of a task, some reports after a checkpoint; between a task's evaluation
# and its checkpoint; between PackNet's last interactions and the evaluation.
@pytest.mark.parametrize(
    ("method", "name", "times"),
    [
        ("ft1", "chunk", 7),
        ("ft1", "evaluate", 3),
        pytest.param("packnet", "offline_update", 2, marks=pytest.mark.slow),
    ],
)
def test_nothing_is_there_twice_and_nothing_missing_after_a_kill(
    method: str,
    name: str,
    times: int,
    tmp_path: Path,
    runs: list[FakeRun],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = tiny(method=method)
    killing(monkeypatch, name, times)
    with pytest.raises(Killed):
        train_run.train(settings, tmp_path / "run", log=BOTH)
    train_run.train(settings, tmp_path / "run", log=BOTH, resume=True)
    for seed in range(2):
        right = expected([tmp_path / "run"], seed, settings.interactions)
        folder = tmp_path / "run" / "tensorboard" / f"seed-{seed}"
        assert len(list(folder.iterdir())) == 2
        same(shown(folder), right)
        same(logged(runs[seed::2]), right)


def small() -> Settings:
    settings = tiny(method="ft1")
    sac = replace(settings.sac, hidden=8, batch_size=8)
    return replace(settings, tasks=2, interactions=320, checkpoint_every=0, sac=sac)


def test_a_run_for_each_member(tmp_path: Path, runs: list[FakeRun]) -> None:
    words = ["train", "probe/reach", "--out", str(tmp_path / "run"), *flags(small())]
    main.main([*words, "--log", "wandb", "tensorboard"])
    assert len({run.options["id"] for run in runs}) == 2
    for seed, run in enumerate(runs):
        assert run.options["name"] == f"run seed-{seed}"
        assert run.options["group"] == "probe/reach/ft1"
        assert run.options["project"] == "rewire_jax"
        assert run.options["config"]["seed"] == seed
        assert run.options["config"]["seeds"] == 1
        assert run.options["config"]["sac"]["hidden"] == 8
        assert run.options["dir"] == str(tmp_path / "run")
        assert run.options["reinit"] == "create_new"
        assert run.axes["*"] == "interactions"
        assert run.finished == 1
    numbers = [dict(logged([run])) for run in runs]
    assert numbers[0] != numbers[1]


def test_a_sweeps_members_are_logged_across_tasks_and_batches(
    tmp_path: Path, runs: list[FakeRun]
) -> None:
    out = tmp_path / "sweep"
    axes = {"lr_policy": [1e-4, 1e-3]}
    sweep.sweep(small(), out, axes=axes, members_per_batch=2, log=BOTH)
    names = [
        f"member-{2 * i + seed:03d},lr_policy={value},seed={seed}"
        for i, value in enumerate(("0.0001", "0.001"))
        for seed in range(2)
    ]
    assert sorted(path.name for path in (out / "tensorboard").iterdir()) == names
    tables = sorted(out.glob("task-*/batch-*"))
    assert len(tables) == 4
    for member, name in enumerate(names):
        right = expected(tables, member, 320)
        same(shown(out / "tensorboard" / name), right)
        own = [run for run in runs if run.options["name"] == f"sweep {name}"]
        assert len(own) == 2
        same(logged(own), right)
        assert own[0].options["config"]["sac"]["lr_policy"] == [1e-4, 1e-3][member // 2]


def test_what_cannot_be_logged_to_is_said_before_anything_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(
        loggers.KINDS, "wandb", Kind("no_such_package", loggers.open_wandb)
    )
    with pytest.raises(UserError, match=r"pip install 'rewire_jax\[wandb\]'"):
        train_run.train(tiny(), tmp_path / "run", log=["wandb"])
    with pytest.raises(UserError, match="'wandbb': choose among tensorboard, wandb"):
        sweep.sweep(tiny(), tmp_path / "run", axes={"alpha": [0, 1]}, log=["wandbb"])
    assert not (tmp_path / "run").exists()


def faulty(when: str) -> Callable[[Subject, int], Logger]:
    def fail(*_: object) -> None:
        raise OSError("No space left\non device")

    def open_(subject: Subject, begin: int) -> Logger:
        if when == "open" and subject.name == "seed-1":
            fail()
        return Logger(
            fail if when == "scalars" else lambda *_: None,
            fail if when == "close" else lambda: None,
        )

    return open_


@pytest.mark.parametrize("when", ["open", "scalars", "close"])
def test_a_failure_is_one_line_and_the_other_logs_go_on(
    when: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(loggers.KINDS, "wandb", Kind("json", faulty(when)))
    said: list[str] = []
    subjects = [Subject(tmp_path, f"seed-{i}", "group", {}) for i in range(2)]
    with Loggers(["wandb", "tensorboard"], subjects, said.append) as logs:
        logs.open(0)
        for step in (0, 10):
            for place in range(2):
                logs.scalars(place, "training", {"a": 1.0, "b": None}, step)
    assert len(said) == 1
    assert re.fullmatch("--log wandb failed .*: No space left on device", said[0])
    for i in range(2):
        numbers = shown(tmp_path / "tensorboard" / f"seed-{i}")
        assert numbers == {("training/a", 0): [1.0], ("training/a", 10): [1.0]}


def test_without_a_key_or_a_folder_training_goes_on(
    tmp_path: Path,
    runs: list[FakeRun],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("WANDB_MODE", "online")
    run, plain = tmp_path / "run", tmp_path / "plain"

    def in_the_way(*rest: Any) -> Progress:
        (run / "tensorboard").touch()
        return Progress(*rest)

    train_run.train(small(), run, log=BOTH, progress=in_the_way)
    said = capsys.readouterr().err
    assert "no API key: run `wandb login` or set WANDB_MODE=offline" in said
    assert all(said.count(f"--log {kind} failed") == 1 for kind in BOTH)
    train_run.train(small(), plain)
    for table in ("results.jsonl", "training.jsonl"):
        assert (run / table).read_bytes() == (plain / table).read_bytes()
    assert not runs


@pytest.mark.slow
def test_the_real_thing_without_a_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("wandb", reason="rewire_jax[wandb] is not installed")
    monkeypatch.setenv("WANDB_MODE", "offline")
    killing(monkeypatch, "chunk", 3)
    with pytest.raises(Killed):
        train_run.train(small(), tmp_path / "run", log=["wandb"])
    train_run.train(small(), tmp_path / "run", log=["wandb"], resume=True)
    for seed in range(2):
        known = json.loads((tmp_path / "run/wandb" / f"seed-{seed}.json").read_text())
        assert known["training"] == known["evaluation"] == 2 * 320
        written = list(
            (tmp_path / "run/wandb").glob(f"offline-*/run-{known['id']}.wandb")
        )
        assert len(written) == 2
        assert all(path.stat().st_size > 0 for path in written)
