"""A report: tables and pictures of results, and how it is written and printed."""

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from rich.console import Console
from rich.text import Text

from rewire_jax.reports import own_files
from rewire_jax.reports.table import Table, to_markdown, to_rich

Numbers = TypeVar("Numbers", covariant=True)


@dataclass(frozen=True)
class Report(Generic[Numbers]):
    """What is written, and the numbers in it.

    Attributes:
        folder: where it is written.
        name: name of its page.
        title: scenario, profile, budget, backend, seeds.
        notes: what a reader must know first.
        numbers: a `Comparison` of runs, or a `SweepSummary`.
        table: the first of the page.
        shown: tables for a terminal, which shows the end best.
        reading: how to read the tables.
        texts: files of numbers by name.
        pictures: their titles, by name of the file.
        draw: draws them into a folder.
        details: lines of Markdown below the pictures.
        origins: a line of Markdown for each result.
    """

    folder: Path
    name: str
    title: str
    notes: tuple[str, ...]
    numbers: Numbers
    table: Table
    shown: tuple[Table, ...]
    reading: tuple[str, ...]
    texts: dict[str, str]
    pictures: dict[str, str]
    draw: Callable[[Path], None]
    details: list[str]
    origins: list[str]

    @property
    def page(self) -> Path:
        """The Markdown with tables and pictures."""
        return self.folder / self.name

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of the report, the page first."""
        names = self.name, *self.texts, *self.pictures
        return tuple(self.folder / name for name in names)

    def write(self) -> None:
        """Writes all files; an old report is replaced when the new one is complete.

        Raises:
            UserError: the folder cannot be written, or has a file of such a name that
                is of no report.
        """
        # Here, because Matplotlib takes long to import.
        from rewire_jax.reports.plots import plain_text

        page, *others = self.paths
        with own_files.replacing(page, others) as new:
            for name, text in {self.name: self._markdown(), **self.texts}.items():
                (new / name).write_text(text, encoding="utf-8")
            with plain_text():
                self.draw(new)

    def _markdown(self) -> str:
        notes = (f"**{note}**" for note in self.notes)
        shown = (f"![{title}]({name})" for name, title in self.pictures.items())
        lines = [f"# {self.title}", *notes, "\n".join(to_markdown(*self.table)[:-1])]
        lines += [*self.reading, *shown]
        parts = [line for each in lines for line in (each, "")]
        return "\n".join([*parts, *self.details, *self.origins]) + "\n"


def to_terminal(report: Report[object], width: int = 100) -> str:
    """The report's tables as plain text, for a command to print.

    Args:
        report: what `write_report` gave.
        width: columns to fill at most.
    """
    file = io.StringIO()
    console = Console(file=file, width=width, color_system=None, force_terminal=False)
    console.print(Text(report.title))
    for table in report.shown:
        console.print()
        console.print(to_rich(table))
    console.print()
    for note in (*report.reading, *report.notes):
        console.print(Text(note))
    console.print()
    for path in report.paths:
        # A path that is wrapped cannot be copied.
        console.print(Text(str(path)), soft_wrap=True)
    return file.getvalue()
