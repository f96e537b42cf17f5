"""Reacts to Ctrl-C at once.

Python runs its signal handlers in the main thread, between two instructions. While that
thread waits for a computation or a compilation, this may be minutes after the signal.
"""

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class Stopped(Exception):
    """The run was interrupted and can be resumed; the message says how."""


@contextmanager
def noticed(act: Callable[[int], None]) -> Iterator[None]:
    """Calls `act(1)`, `act(2)`, ... at each Ctrl-C, from another thread.

    Python's handlers run too. Such contexts may be nested.

    Raises:
      ValueError: this is not the main thread.
    """
    here, there = socket.socketpair()
    there.setblocking(False)
    outer = signal.set_wakeup_fd(there.fileno(), warn_on_full_buffer=False)

    def listen() -> None:
        times = 0
        while heard := here.recv(1):
            if outer >= 0:
                os.write(outer, heard)
            if heard[0] == signal.SIGINT:
                times += 1
                act(times)

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(outer)
        there.close()
        thread.join()
        here.close()


@contextmanager
def interruptible(
    stopping: threading.Event, folder: Path, say: Callable[[str], None]
) -> Iterator[None]:
    """Ctrl-C once: stop after the running chunk. Twice: stop at once.

    Args:
      stopping: is set by the first; the run looks at it after each chunk.
      folder: folder of the run.
      say: tells the user.

    Raises:
      Stopped: at once.
    """

    def handle(number: int, frame: Any) -> None:
        if stopping.is_set():
            raise KeyboardInterrupt
        stopping.set()

    def tell(times: int) -> None:
        if times == 1:
            say("stopping after this chunk; Ctrl-C again: at once")

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGINT, handle)
    try:
        with noticed(tell):
            yield
    except KeyboardInterrupt:
        raise Stopped(
            "stopped at once: continue from the newest checkpoint with --resume --out "
            f"{folder}"
        ) from None
    finally:
        signal.signal(signal.SIGINT, previous)
