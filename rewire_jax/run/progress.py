"""A live display of a run in the terminal; plain lines without a terminal."""

import math
import sys
from collections.abc import Sequence
from datetime import timedelta
from types import TracebackType
from typing import Self, TextIO

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

_MOST_NAMES = 6  # with more members, shows the mean and range of their returns


class Progress:
    """Shows the progress of a run; a context manager.

    Without a terminal it writes only a line for each finished task and each message,
    without control codes.

    Args:
        tasks: names of the whole sequence.
        total: interactions of each task.
        members: names of the members, in the order of the returns in `update`.
        label: names the run, such as method and scenario.
        file: where to write, by default the standard error output.
        console: used instead of one made for `file`.
    """

    def __init__(
        self,
        tasks: Sequence[str],
        total: int,
        members: Sequence[str],
        label: str,
        file: TextIO | None = None,
        *,
        console: Console | None = None,
    ) -> None:
        self._tasks = tuple(tasks)
        self._total = total
        self._members = tuple(members)
        self._label = label
        # Otherwise Rich would write HTML into the cell of a notebook.
        self._console = console or Console(file=file or sys.stderr, force_jupyter=False)
        self._live: Live | None = None

    def __enter__(self) -> Self:
        if self._console.is_terminal and not self._console.is_dumb_terminal:
            # Only `update` refreshes it: another thread would slow down training.
            self._live = Live(
                Text(f"{self._label}: starting"),
                console=self._console,
                auto_refresh=False,
                transient=True,
            )
            self._live.start(refresh=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def update(
        self,
        stage: int,
        interactions: int,
        returns: Sequence[float | None],
        rate: float | None,
        seconds_left: float | None = None,
        note: str | None = None,
    ) -> None:
        """Shows the state after a chunk; does nothing without a terminal.

        Args:
            stage: index of the task in training.
            interactions: interactions of each member in this task so far.
            returns: latest training return of each member; None if there is none yet.
            rate: interactions/s of all members together; None if unknown.
            seconds_left: remaining time of the whole run; None if unknown.
            note: anything else, such as "evaluating".
        """
        if self._live is None:
            return
        task = Table.grid(padding=(0, 2))
        task.add_row(
            Text(self._name(stage), style="bold"),
            ProgressBar(self._total, interactions, width=24),
            Text(f"{interactions:,} / {self._total:,} interactions"),
        )
        speed = [] if rate is None else [f"{rate:,.0f} interactions/s"]
        if seconds_left is not None:
            speed.append(f"{_clock(seconds_left)} left")
        if note:
            speed.append(note)
        self._live.update(
            Group(
                Text(self._label),
                task,
                Text(f"return  {self._returns(returns)}"),
                Text("   ".join(speed)),
            ),
            refresh=True,
        )

    def finish_task(
        self, stage: int, returns: Sequence[float | None], seconds: float
    ) -> None:
        """Prints the line of a finished task.

        Args:
            stage: index of the task.
            returns: evaluation return of each member on this task.
            seconds: duration of the task.
        """
        self.message(
            f"{self._label}: {self._name(stage)} finished in {_clock(seconds)}, "
            f"return {self._returns(returns)}"
        )

    def message(self, text: str) -> None:
        """Prints a line, above the live display if there is one."""
        self._console.print(Text(text), soft_wrap=True)

    def _name(self, stage: int) -> str:
        return f"task {stage + 1} of {len(self._tasks)}, {self._tasks[stage]}"

    def _returns(self, returns: Sequence[float | None]) -> str:
        """The return of each member, or their mean and range."""
        if len(returns) <= _MOST_NAMES:
            pairs = zip(self._members, returns, strict=True)
            return "  ".join(f"{name}: {_number(x)}" for name, x in pairs)
        known = [x for x in returns if x is not None and math.isfinite(x)]
        if not known:
            return _number(None)
        missing = len(returns) - len(known)
        return (
            f"mean {_number(sum(known) / len(known))}, "
            f"{_number(min(known))} to {_number(max(known))} in {len(known)} members"
            + (f", none in {missing}" if missing else "")
        )


def _number(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}"


def _clock(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))
