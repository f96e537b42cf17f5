"""Where a run's scalars go beside its tables: TensorBoard, Weights & Biases.

Each member has a log of its own. What counts is in the tables; these are for looking
at. Whatever fails in them is told once, and training goes on without them.
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

from rewire_jax.core.settings import Settings, require, to_json
from rewire_jax.storage import run_folder
from rewire_jax.training.population import Member


class Subject(NamedTuple):
    """Whose scalars are logged.

    Attributes:
      folder: of the run or sweep.
      name: the member's, unlike any other in the folder.
      group: what the members have in common.
      settings: the member's, JSON-ready.
    """

    folder: Path
    name: str
    group: str
    settings: dict[str, Any]


class Logger(NamedTuple):
    """The log of one member.

    Attributes:
      scalars: takes a kind, "training" or "evaluation", numbers by name, and the
        interactions made by then. The times of a kind only grow.
      close: there is no more to come.
    """

    scalars: Callable[[str, Mapping[str, float], int], None]
    close: Callable[[], None]


class Kind(NamedTuple):
    """How logs of one kind are opened.

    Attributes:
      package: that must be installed; the extra has the kind's own name.
      open: from whose it is and the number of interactions from which on nothing is
        known. The run may have been stopped and resumed: what was logged later than
        that will be logged again.
    """

    package: str
    open: Callable[[Subject, int], Logger]


def open_tensorboard(subject: Subject, begin: int) -> Logger:
    """Event files in `tensorboard/`, on disk after each call."""
    # SummaryWriter's thread, once it has failed, leaves its caller waiting for ever.
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event, SessionLog
    from tensorboardX.proto.summary_pb2 import Summary

    folder = subject.folder / "tensorboard" / subject.name
    folder.mkdir(parents=True, exist_ok=True)
    writer = EventsWriter(str(folder / "events"), f".{begin:012d}")
    # Hides what an earlier file has from here on.
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
    """A run at Weights & Biases, or with WANDB_MODE=offline in `wandb/`.

    That folder also has each run's id and how far it was logged: a run that is resumed
    goes on under the same id, and logs nothing twice. What was logged in the second
    before a kill may be lost.

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
    # It would ask at the terminal, in the middle of the display.
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
    # Not its own steps: those are lost where they do not grow.
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
    """Raises `UserError` for logs of an unknown kind, or whose package is missing."""
    for kind in kinds:
        known = ", ".join(KINDS)
        require(kind in KINDS, f"unknown log {kind!r}: choose among {known}")
        package = KINDS[kind].package
        require(
            importlib.util.find_spec(package) is not None,
            f"--log {kind} needs {package}: pip install 'rewire_jax[{kind}]'",
        )


def subject(folder: Path, settings: Settings, member: Member, name: str) -> Subject:
    """Whose log a member's is."""
    own = dataclasses.replace(
        settings, seed=member.seed, seeds=1, sac=member.sac, options=member.options
    )
    group = f"{settings.scenario}/{settings.method}"
    return Subject(folder, name, group, to_json(own))


class Loggers:
    """The logs of some members, open for as long as the context lasts."""

    def __init__(
        self,
        kinds: Sequence[str],
        subjects: Sequence[Subject],
        say: Callable[[str], None],
    ):
        """Opens nothing yet.

        Args:
          kinds: of logs, as `check` allows them.
          subjects: one for each member, in their order.
          say: is told what fails.
        """
        self._kinds = tuple(kinds)
        self._subjects = tuple(subjects)
        self._say = say
        self._open: dict[str, list[Logger]] = {}

    def open(self, begin: int) -> None:
        """Opens them; `begin` is as in `Kind`."""
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
        """Logs what is known of a member's values; see `Logger`."""
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
            self._say(f"--log {kind} failed and is off from here on: {reason}")
