"""Puts committed results into the README, between its markers.

`<!-- results: NAME -->` and `<!-- end -->` enclose what is made from
`experiments/results/NAME/report.md`, or from `experiments/results/NAME.md`.
"""

import re
import sys
from pathlib import Path

from rewire_jax.errors import UserError

README = Path("README.md")
RESULTS = Path("experiments/results")
_BLOCK = re.compile(r"(<!-- results: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def fill(text: str, results: Path = RESULTS) -> str:
    """The text with every marked block made anew.

    Raises:
      UserError: a block names results that are not there.
    """

    def block(match: re.Match[str]) -> str:
        folder = results / match[2]
        source = folder / "report.md" if folder.is_dir() else results / f"{match[2]}.md"
        try:
            report = source.read_text()
        except OSError as error:
            raise UserError(f"README.md names {match[2]}: no {source}") from error
        # A title there is a section's heading here; pictures lie in its folder.
        report = re.sub(r"^#+ ", "#### ", report, flags=re.MULTILINE)
        report = re.sub(r"\]\((?!http)", f"]({source.parent.as_posix()}/", report)
        return f"{match[1]}\n{report.strip()}\n\n{match[3]}"

    return _BLOCK.sub(block, text)


def main() -> None:
    """Rewrites README.md where its results changed."""
    try:
        README.write_text(fill(README.read_text()))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
