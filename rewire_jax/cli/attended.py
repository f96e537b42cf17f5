"""Trains as `rewire-jax` does, until the process that started it ends.

That process keeps a pipe to the standard input open. When it ends, in any way, the run
is saved and ends too.
"""

import os
import signal
import sys
import threading

from rewire_jax.cli.main import main


def _watch() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGINT)


if __name__ == "__main__":
    threading.Thread(target=_watch, daemon=True).start()
    sys.argv[0] = "rewire-jax"  # as a run's provenance names the command
    main()
