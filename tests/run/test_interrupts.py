import hashlib
import os
import signal
import threading

from rewire_jax.run.interrupts import noticed


def compute() -> None:
    """Leaves no time for Python's signal handlers, but for other threads."""
    hashlib.pbkdf2_hmac("sha256", b"", b"", 1_000_000)


def test_it_is_noticed_while_something_is_computed() -> None:
    events: list[str] = []
    before = signal.signal(signal.SIGINT, lambda *_: events.append("handled"))
    press = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT))
    try:
        with (
            noticed(lambda times: events.append(f"outer {times}")),
            noticed(lambda times: events.append(f"noticed {times}")),
        ):
            press.start()
            compute()
        assert events[0] != "handled"
        assert sorted(events) == ["handled", "noticed 1", "outer 1"]
        # And no more afterwards.
        os.kill(os.getpid(), signal.SIGINT)
        assert len(events) == 4
    finally:
        signal.signal(signal.SIGINT, before)


def test_times_are_counted() -> None:
    heard: list[int] = []
    third = threading.Event()

    def act(times: int) -> None:
        heard.append(times)
        if times == 3:
            third.set()

    before = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        with noticed(act):
            for _ in range(3):
                os.kill(os.getpid(), signal.SIGINT)
            assert third.wait(60)
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == [1, 2, 3]
