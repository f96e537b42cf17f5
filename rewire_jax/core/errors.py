"""Errors that the user can fix, each in one line."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_SPACE = "free space or choose another folder"
_OTHER = "make it writable or choose another folder"
_FILES = "raise `ulimit -n`"
_REMEDIES = {
    errno.ENOSPC: _SPACE,
    errno.EDQUOT: _SPACE,
    errno.EROFS: _OTHER,
    errno.EACCES: "change its permissions",
    errno.EPERM: "change its permissions",
    errno.EMFILE: _FILES,
    errno.ENFILE: _FILES,
    errno.EFBIG: "raise `ulimit -f`",
}


def remedy(code: int | None) -> str:
    """What the user can do if a file fails with this `errno`."""
    what = _REMEDIES.get(code or 0, f"free space, {_OTHER}")
    return f"{what}, then run the command again, with --resume if it trains"


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
        told = f"cannot write to {where}: {why}; {remedy(error.errno)}"
        raise UserError(told) from error
