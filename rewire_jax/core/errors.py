"""Errors a user can mend, told in one line."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

REMEDY = (
    "free space, make it writable or name another, and give the command again, with "
    "--resume if it trains"
)
"""What to do where nothing can be written."""


class UserError(Exception):
    """Something the caller can mend; the message is one line that says how.

    The command line prints the message without a traceback and exits with 2.
    """


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """What the system refuses inside is a `UserError`: of `path`, or a file in it."""
    try:
        yield
    except OSError as error:
        where, why = error.filename or path, error.strerror or error
        raise UserError(f"cannot write to {where}: {why}; {REMEDY}") from error
