"""Fills committed results into the README and the pages, between their markers.

The text between `<!-- results: NAME -->` and `<!-- end -->` comes from
`experiments/results/NAME/report.md` or from `experiments/results/NAME.md`.
`<!-- results: NAME | HEAD | HEAD -->` takes only the title and the first table, with
the columns whose headings start with these words.
"""

import itertools
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from rewire_jax.core.errors import UserError
from rewire_jax.reports.table import to_markdown

PAGES = (Path("README.md"), Path("docs/results.md"), Path("docs/speed.md"))
RESULTS = Path("experiments/results")
_BLOCK = re.compile(
    r"(<!-- results: (\S+)(?: \| ([^\n]*))? -->\n).*?(<!-- end -->)", re.DOTALL
)
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_BETWEEN = re.compile(r"(?<!\\)\|")
_FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)


def fill(text: str, page: Path = PAGES[0], results: Path = RESULTS) -> str:
    """The text with every marked block filled again.

    Args:
      text: of the page.
      page: its path; links in results become relative to it.
      results: folder of all results.

    Raises:
      UserError: a block names results or a column that do not exist.
    """

    def block(match: re.Match[str]) -> str:
        begin, name, heads, end = match.groups()
        folder = results / name
        source = folder / "report.md" if folder.is_dir() else results / f"{name}.md"
        try:
            report = _COMMENT.sub("", source.read_text())
        except OSError as error:
            raise UserError(f"{page} names {name}: no {source}") from error
        if heads:
            report = _columns(report, heads.split(" | "), name)
        # A title there is a heading here, one level below its section's.
        above = _FENCED.sub("", _BLOCK.sub("", text[: match.start()]))
        level = max([0, *map(len, re.findall(r"^(#+) ", above, re.MULTILINE)[-1:])])
        report = re.sub(r"^#", "#" * (level + 1), report, flags=re.MULTILINE)
        way = Path(os.path.relpath(source.parent, page.parent)).as_posix()
        report = re.sub(r"\]\((?!http)", f"]({way}/", report)
        return f"{begin}\n{report.strip()}\n\n{end}"

    return _BLOCK.sub(block, text)


def _columns(report: str, heads: Sequence[str], name: str) -> str:
    """The title of a report, and some columns of its first table."""
    title, *lines = report.splitlines()
    lines = list(itertools.dropwhile(lambda line: not line.startswith("|"), lines))
    table = itertools.takewhile(lambda line: line.startswith("|"), lines)
    rows = [[cell.strip() for cell in _BETWEEN.split(line[1:-1])] for line in table]
    places = []
    for head in heads:
        found = [i for i, cell in enumerate(rows[0]) if cell.startswith(head)]
        if not found:
            raise UserError(f"{name} has no column that begins with {head!r}")
        places.append(found[0])
    top, _, *body = ([row[i].replace(r"\|", "|") for i in places] for row in rows)
    return "\n".join([title, "", *to_markdown(top, body)])


def main() -> None:
    """Rewrites the pages whose results changed."""
    try:
        for page in PAGES:
            page.write_text(fill(page.read_text(), page))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
