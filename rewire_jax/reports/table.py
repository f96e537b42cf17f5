"""Tables of text, for Markdown and for a terminal."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from rich import box
from rich import table as rich_table
from rich.text import Text

_WORD = re.compile(r"^\W*[^\W\d_]|[^\W\d_]{3}")


class Table(NamedTuple):
    """Headings, and rows as long."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]

    def words(self, column: int) -> bool:
        """Whether a column holds words, and not only numbers, signs and units."""
        return any(_WORD.search(row[column]) for row in self.rows)


def to_markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table in Markdown, the last one empty; numbers are set to the right.

    Cells are not padded, so that a changed number changes one line of a committed page.
    """
    table = Table(heads, rows)
    rule = ["---" if table.words(k) else "---:" for k in range(len(heads))]
    lines = [[cell.replace("|", r"\|") for cell in row] for row in (heads, *rows)]
    lines.insert(1, rule)
    return [*(f"| {' | '.join(cells)} |" for cells in lines), ""]


def to_rich(table: Table) -> rich_table.Table:
    """The table for a terminal; the first cell is left out where it repeats."""
    shown = rich_table.Table(
        box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True
    )
    for k, head in enumerate(table.heads):
        if table.words(k):
            shown.add_column(head, overflow="fold")
        else:
            # The heading breaks between words, so that numbers need not.
            texts = head.split() + [row[k] for row in table.rows]
            shown.add_column(head, justify="right", width=max(map(len, texts)))
    last = ""
    for first, *cells in table.rows:
        shown.add_row(Text("" if first == last else first), *map(Text, cells))
        last = first
    return shown
