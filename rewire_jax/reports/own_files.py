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
    """A new folder for files, which at the end of the block replace those there.

    Args:
      page: the page, in a folder that is made where missing.
      others: the other files, in the same folder.

    Raises:
      UserError: the folder cannot be written, or a file that is there was not written
        with the page there, or was changed since. Nothing is replaced then.
    """
    with writing(page.parent):
        page.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=page.parent, prefix=".report-") as made:
            new = Path(made)
            yield new
            held = _check(page, others, new)
            _sign(new / page.name, held)
            # The page knows old and new files. It comes first, so that the next report
            # replaces one that was killed between two files.
            for path in (page, *others):
                (new / path.name).replace(path)


def _check(page: Path, others: Sequence[Path], new: Path) -> dict[str, str]:
    """Digests of the other files that are there; `UserError` if a file is not ours."""
    text, told = _read(page)
    found = {}
    for path in (page, *others):
        if path.exists() or path.is_symlink():
            held = raw(path)
            found[path.name] = _digest(text if path == page else held)
            ours = found[path.name] in told.get(path.name, ())
            if not ours and held != (new / path.name).read_bytes():
                raise UserError(
                    f"{path} was not written by `report`, or was changed since: move "
                    "it away, or name another --out"
                )
    found.pop(page.name, None)
    return found


def _sign(page: Path, held: dict[str, str]) -> None:
    """Adds digests to a page: of all files in its folder, and of those they replace."""
    digests = {}
    for path in page.parent.iterdir():
        both = _digest(path.read_bytes()), held.get(path.name)
        digests[path.name] = list(dict.fromkeys(filter(None, both)))
    with page.open("ab") as file:
        file.write(_BEGIN + json.dumps(digests, sort_keys=True).encode() + _END)


def _read(page: Path) -> tuple[bytes, dict[str, list[str]]]:
    """The text of a page without its comment, and the digests in it."""
    text, _, comment = (raw(page) if page.exists() else b"").rpartition(_BEGIN)
    try:
        told = json.loads(comment.removesuffix(_END))
        # Older versions had one digest of each file.
        return text, {
            name: [each] if isinstance(each, str) else list(each)
            for name, each in told.items()
        }
    except (ValueError, TypeError, AttributeError):
        return text, {}


def _digest(held: bytes) -> str:
    return hashlib.sha256(held).hexdigest()[:16]
