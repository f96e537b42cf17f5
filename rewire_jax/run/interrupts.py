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
