"""Errors that the user can fix, each in one line."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

REMEDY = (
    "free space, make it writable or choose another, then run the command again, "
    "with --resume if it trains"
)
"""What the user can do if nothing can be written."""


class UserError(Exception):
    """An error that the caller can fix; the message is one line that says how.

    The command line prints the message without a traceback and exits with 2.
    """


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns an `OSError` into a `UserError` that names `path` or a file in it."""
    try:
        yield
    except OSError as error:
        where, why = error.filename or path, error.strerror or error
        raise UserError(f"cannot write to {where}: {why}; {REMEDY}") from error
