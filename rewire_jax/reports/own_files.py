"""Which files a report wrote: digests in a comment at the end of its page."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from rewire_jax.core.errors import UserError, writing
from rewire_jax.storage.json_lines import raw

_BEGIN, _END = b"\n<!-- digests of this report's files: ", b" -->\n"


@contextmanager
def replacing(page: Path, others: Sequence[Path]) -> Iterator[Path]:
    """A new folder to write files into, which then replace those of the last time.

    Args:
      page: the page, in a folder that is made where missing.
      others: the other files, in the same folder.

    Raises:
      UserError: the folder cannot be written, or as `replace`.
    """
    with writing(page.parent):
        page.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=page.parent, prefix=".report-") as made:
            new = Path(made)
            yield new
            sign(new / page.name)
            replace(page, others, new)


def sign(page: Path) -> None:
    """Adds the digests of all files in its folder, itself included, to a page."""
    digests = {path.name: _digest(path.read_bytes()) for path in page.parent.iterdir()}
    with page.open("ab") as file:
        file.write(_BEGIN + json.dumps(digests, sort_keys=True).encode() + _END)


def replace(page: Path, others: Sequence[Path], new: Path) -> None:
    """Moves new files to the places of a page and of its other files.

    Args:
      page: the page; a signed one may be there.
      others: the other files; the page is replaced after them.
      new: folder of the new files, of the same names.

    Raises:
      UserError: a file that is there was not written with the page there, or was
        changed since. Nothing is moved.
    """
    text, told = _read(page)
    for path in (page, *others):
        if path.exists() or path.is_symlink():
            held = raw(path)
            ours = told.get(path.name) == _digest(text if path == page else held)
            if not ours and held != (new / path.name).read_bytes():
                raise UserError(
                    f"{path} was not written by `report`, or was changed since: move "
                    "it away, or name another --out"
                )
    for path in (*others, page):
        (new / path.name).replace(path)


def _read(page: Path) -> tuple[bytes, dict[str, str]]:
    """The text of a page without its comment, and the digests in it."""
    text, _, comment = (raw(page) if page.exists() else b"").rpartition(_BEGIN)
    try:
        told = json.loads(comment.removesuffix(_END))
        return text, told if isinstance(told, dict) else {}
    except ValueError:
        return text, {}


def _digest(held: bytes) -> str:
    return hashlib.sha256(held).hexdigest()[:16]
