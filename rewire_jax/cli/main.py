"""The `rewire-jax` command."""

import contextlib
import errno
import io
import os
import re
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator, Sequence

from rich.console import Console

from rewire_jax.cli import arguments
from rewire_jax.core.arguments import require
from rewire_jax.core.compilation_cache import keep_compiled
from rewire_jax.core.errors import UserError, remedy
from rewire_jax.core.machine_memory import address_limit
from rewire_jax.run import interrupts
from rewire_jax.version import __version__

_INTERRUPTED = 130
_PIPE_CLOSED = 141
_LEAST_MEMORY = 2**31


def main(words: Sequence[str] | None = None) -> None:
    """Runs a command.

    Exits with 2 on a user's error, 130 on an interruption, 1 on anything unexpected.
    """
    words = sys.argv[1:] if words is None else words
    debug = "--debug" in words
    if not debug:
        sys.unraisablehook = _unraisable
        # Orbax leaves coroutines behind where it fails.
        warnings.filterwarnings("ignore", "coroutine .* was never awaited")
    # Streams may be closed, as by `>&-`.
    sys.stdout = sys.stdout or io.StringIO()
    sys.stderr = sys.stderr or io.StringIO()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # where a terminal knows ASCII only
    try:
        with _stoppable():
            _run(words)
            sys.stdout.flush()
    except BrokenPipeError:
        # Who read the output has closed it, as `head` does.
        _discard_output()
        sys.exit(_PIPE_CLOSED)
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        line, status = _ending(error)
        with contextlib.suppress(OSError):
            print(line, file=sys.stderr)
        sys.exit(status)


def _run(words: Sequence[str]) -> None:
    known = arguments.first(words)
    if known.version:
        print(f"rewire_jax {__version__}")
        return
    limit = address_limit()
    require(
        limit is None or limit >= _LEAST_MEMORY,  # With less, XLA aborts.
        f"too little memory, {(limit or 0) / 1e6:.0f} MB: raise `ulimit -v` to "
        f"{_LEAST_MEMORY // 1024} or more",
    )
    keep_compiled(known.cache)
    arguments.command(words, known)()


def _discard_output() -> None:
    """Keeps Python from trying again when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def _stoppable() -> Iterator[None]:
    """A second Ctrl-C ends the process if it does not end by itself in a second."""
    heard, over = threading.Event(), threading.Event()

    def end(times: int) -> None:
        heard.set()
        if times == 2 and not over.wait(1.0):
            # A live display has hidden the cursor.
            Console(stderr=True).show_cursor()
            print(
                "stopped immediately: checkpoints remain; continue with --resume",
                file=sys.stderr,
                flush=True,
            )
            os._exit(_INTERRUPTED)

    with interrupts.noticed(end):
        try:
            yield
        finally:
            over.set()
            if heard.is_set():  # The process ends and prints nothing more.
                signal.signal(signal.SIGINT, signal.SIG_IGN)


def _unraisable(report: "sys.UnraisableHookArgs") -> None:
    """Prints an error in a library's thread, except those after a failed write.

    Orbax closes its event loop when an array cannot be written, as on a full disk. Then
    TensorStore has no loop to tell of the other arrays, and says so for each of them.
    Where too many files are open, a loop is closed that has no socket.
    """
    if not re.search("Event loop is closed|_ssock", str(report.exc_value)):
        sys.__unraisablehook__(report)


def _ending(error: BaseException) -> tuple[str, int]:
    """The line in which a command ends, and its exit status."""
    if isinstance(error, UserError):
        return f"error: {error}", 2
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        # Files are written by those who make a `UserError` of it.
        _discard_output()
        return f"error: cannot write to the standard output: {error.strerror}", 2
    if isinstance(error, interrupts.Stopped):
        return str(error), _INTERRUPTED
    if isinstance(error, KeyboardInterrupt):
        stopped = isinstance(error.__context__, interrupts.Stopped)  # and then again
        return str(error.__context__) if stopped else "interrupted", _INTERRUPTED
    said = f"{type(error).__name__}: {error}".partition("\n")[0]
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        return f"error: {error}: {remedy(error.errno)}", 2
    no_memory = isinstance(error, OSError) and error.errno == errno.ENOMEM
    if no_memory or isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in said:
        raised = "raise `ulimit -v`, or " if address_limit() else ""
        return (
            f"error: out of memory: {raised}lower --seeds, --envs, --buffer, --hidden "
            "or --eval-episodes",
            2,
        )
    return (
        f"error: unexpected {said}; run again with --debug to see where, and please "
        "report it",
        1,
    )


if __name__ == "__main__":
    main()
