"""Logs a run's scalars to TensorBoard and to Weights & Biases.

Each member has its own log. The result tables do not depend on the logs. If a log
fails, a message says so once, and training continues without it.
"""

import contextlib
import dataclasses
import importlib.util
import json
import os
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

from rewire_jax.core.arguments import require
from rewire_jax.core.settings import Settings
from rewire_jax.core.settings_json import to_json
from rewire_jax.storage import run_folder
from rewire_jax.training.population import Member


class Subject(NamedTuple):
    """The member whose scalars are logged.

    Attributes:
      folder: folder of the run or sweep.
      name: name of the member, unique in the folder.
      group: a name that all members share.
      settings: settings of the member, JSON-ready.
    """

    folder: Path
    name: str
    group: str
    settings: dict[str, Any]


class Logger(NamedTuple):
    """The log of one member.

    Attributes:
      scalars: logs numbers by name. Its arguments are a kind, "training" or
        "evaluation", the numbers, and the interactions so far; within a kind these only
        grow.
      close: ends the log.
    """

    scalars: Callable[[str, Mapping[str, float], int], None]
    close: Callable[[], None]


class Kind(NamedTuple):
    """How to open logs of one kind.

    Attributes:
      package: the required package; the extra has the name of the kind.
      open: opens the log of a member. Its second argument is the number of interactions
        at which the run starts or resumes. Everything that was logged after this number
        will be logged again.
    """

    package: str
    open: Callable[[Subject, int], Logger]


def open_tensorboard(subject: Subject, begin: int) -> Logger:
    """Event files in `tensorboard/`, flushed to disk after each call."""
    # If SummaryWriter's thread fails, its caller waits forever.
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event, SessionLog
    from tensorboardX.proto.summary_pb2 import Summary

    folder = subject.folder / "tensorboard" / subject.name
    folder.mkdir(parents=True, exist_ok=True)
    writer = EventsWriter(str(folder / "events"), f".{begin:012d}")
    # Hides what an earlier file has logged after this point.
    start = SessionLog(status=SessionLog.START)
    writer.write_event(Event(wall_time=time.time(), step=begin, session_log=start))

    def scalars(kind: str, values: Mapping[str, float], interactions: int) -> None:
        entries = [
            Summary.Value(tag=f"{kind}/{name}", simple_value=value)
            for name, value in values.items()
        ]
        summary = Summary(value=entries)
        event = Event(wall_time=time.time(), step=interactions, summary=summary)
        writer.write_event(event)
        writer.flush()

    return Logger(scalars, writer.close)


def open_wandb(subject: Subject, begin: int) -> Logger:
    """A run at Weights & Biases, or in `wandb/` with WANDB_MODE=offline.

    The folder `wandb/` also stores the id of each run and how far it was logged. So a
    resumed run continues under the same id and logs nothing twice. A kill may lose what
    was logged in the last second.

    Raises:
      ConnectionError: there is no API key, or no network.
    """
    import wandb

    path = subject.folder / "wandb" / f"{subject.name}.json"
    known: dict[str, Any] = {
        "id": secrets.token_hex(8),
        "training": -1,
        "evaluation": -1,
    }
    if path.exists():
        known = json.loads(path.read_text())
    path.parent.mkdir(parents=True, exist_ok=True)
    offline = os.environ.get("WANDB_MODE", "online") != "online"
    # Otherwise it would ask for the key in the middle of the display.
    if not offline and not wandb.login(prompt=False):
        raise ConnectionError("no API key: run `wandb login` or set WANDB_MODE=offline")
    run = wandb.init(
        project=os.environ.get("WANDB_PROJECT", "rewire_jax"),
        group=subject.group,
        name=f"{subject.folder.resolve().name} {subject.name}",
        id=known["id"],
        resume="allow",
        reinit="create_new",
        dir=str(subject.folder),
        config=subject.settings,
        settings=wandb.Settings(
            console="off",
            silent=True,
            finish_timeout=60,
            x_transaction_log_flush_interval=1,
        ),
    )
    run_folder.write(path, known)
    # wandb drops values whose own step does not grow, so the axis is a metric.
    run.define_metric("interactions", hidden=True)
    run.define_metric("*", step_metric="interactions")

    def scalars(kind: str, values: Mapping[str, float], interactions: int) -> None:
        if interactions > known[kind]:
            named = {f"{kind}/{name}": value for name, value in values.items()}
            run.log(named | {"interactions": interactions})
            known[kind] = interactions
            run_folder.write(path, known)

    return Logger(scalars, run.finish)


KINDS = {
    "tensorboard": Kind("tensorboardX", open_tensorboard),
    "wandb": Kind("wandb", open_wandb),
}


def check(kinds: Sequence[str]) -> None:
    """Raises `UserError` if a kind of log is unknown or its package is missing."""
    for kind in kinds:
        known = ", ".join(KINDS)
        require(kind in KINDS, f"unknown log {kind!r}: choose among {known}")
        package = KINDS[kind].package
        require(
            importlib.util.find_spec(package) is not None,
            f"--log {kind} needs {package}: pip install 'rewire_jax[{kind}]'",
        )


def subject(folder: Path, settings: Settings, member: Member, name: str) -> Subject:
    """The `Subject` of a member's log."""
    own = dataclasses.replace(
        settings, seed=member.seed, seeds=1, sac=member.sac, options=member.options
    )
    group = f"{settings.scenario}/{settings.method}"
    return Subject(folder, name, group, to_json(own))


class Loggers:
    """The logs of some members; leaving the context closes them."""

    def __init__(
        self,
        kinds: Sequence[str],
        subjects: Sequence[Subject],
        say: Callable[[str], None],
    ):
        """Opens nothing yet.

        Args:
          kinds: kinds of logs that `check` allows.
          subjects: one for each member, in their order.
          say: receives a message if a log fails.
        """
        self._kinds = tuple(kinds)
        self._subjects = tuple(subjects)
        self._say = say
        self._open: dict[str, list[Logger]] = {}

    def open(self, begin: int) -> None:
        """Opens the logs; `begin` is the second argument of `Kind.open`."""
        for kind in self._kinds:
            with self._guarded(kind):
                opened = self._open[kind] = []
                for each in self._subjects:
                    opened.append(KINDS[kind].open(each, begin))

    def scalars(
        self,
        place: int,
        kind: str,
        values: Mapping[str, float | None],
        interactions: int,
    ) -> None:
        """Logs the values of the member at `place`, except None; see `Logger`."""
        finite = {name: value for name, value in values.items() if value is not None}
        for each, logs in list(self._open.items()):
            with self._guarded(each):
                logs[place].scalars(kind, finite, interactions)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for each, logs in list(self._open.items()):
            with self._guarded(each):
                for log in logs:
                    log.close()

    @contextlib.contextmanager
    def _guarded(self, kind: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self._open.pop(kind, None)
            reason = " ".join(str(error).split()) or type(error).__name__
            self._say(f"--log {kind} failed and is now off: {reason}")
