"""Small runs of the real command: how they are stopped, and what they leave."""

import hashlib
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import orbax.checkpoint as ocp

from rewire_jax.storage.run_folder import TABLES

TASKS, SEEDS = 3, 2
TRAIN = f"train probe/reach --profile quick --seeds {SEEDS} --envs 16 --updates 4"
TRAIN += " --hidden 8 --depth 1 --batch-size 16 --eval-episodes 2"
TRAIN += " --selection-episodes 2 --warmup 160"
TURNS = f" --tasks {TASKS} --interactions 640 --report-every 80 --checkpoint-every 160"
RUN = tuple((TRAIN + TURNS).split())
"""Takes seconds. Each task has 40 steps, 8 reports and 3 checkpoints."""
SWEEP = ("sweep", *RUN[1:], "--beta", "0.1", "10", "--members-per-batch", "2")
TURNS = " --tasks 2 --interactions 80000 --report-every 80000 --checkpoint-every 0"
LONG = tuple((TRAIN + TURNS).split())
"""Each task is one chunk, which takes seconds."""
PATIENCE = 600.0  # seconds
Ran = subprocess.CompletedProcess[str]


def start(*words: str | Path, before: Sequence[str] = ()) -> subprocess.Popen[str]:
    """Starts `rewire-jax` in a process group of its own, or what runs it."""
    return subprocess.Popen(
        [*before, sys.executable, "-m", "rewire_jax.cli.main", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def end(process: subprocess.Popen[str]) -> Ran:
    """Waits for the end of a command."""
    out, error = process.communicate(timeout=PATIENCE)
    return Ran(process.args, process.returncode, out, error)


def run(*words: str | Path, before: Sequence[str] = ()) -> Ran:
    """Runs `rewire-jax` to its end."""
    return end(start(*words, before=before))


def wait(process: subprocess.Popen[str], folder: Path, seen: str, rows: int) -> None:
    """Waits until a process has made a file of this pattern, with so many rows."""

    def there(path: Path) -> bool:
        return not rows or path.read_bytes().count(b"\n") >= rows

    limit = time.monotonic() + PATIENCE
    while not any(map(there, folder.glob(seen))):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < limit
        time.sleep(0.0005)


def results(folder: Path) -> Counter[str]:
    """Rows of evaluations and of training, and the arrays that are kept of each task.

    What else a run writes says how long it took, or serves to go on.
    """
    found: list[str] = []
    for path in [path for table in TABLES[:2] for path in folder.rglob(table)]:
        lines = path.read_text().split("\n")[:-1]
        found += [f"{path.relative_to(folder)} {line}" for line in lines]
    for item in folder.rglob("checkpoints/task-[0-9][0-9][0-9]/[a-z]*/"):
        with ocp.PyTreeCheckpointer() as orbax:  # Its files may differ.
            arrays = orbax.restore(item)
        for name, array in arrays.items():
            digest = hashlib.sha256(array.tobytes()).hexdigest()
            found.append(f"{item.relative_to(folder)} {name} {array.shape} {digest}")
    return Counter(found)


def assert_refused(ran: Ran, *told: object) -> None:
    """The command ended in one line of error, its last, that holds what is told."""
    assert ran.returncode == 2, ran.stderr
    assert "Traceback" not in ran.stdout + ran.stderr
    assert ran.stderr.count("error: ") == 1, ran.stderr
    last = ran.stderr.splitlines()[-1]
    assert last.startswith("error: "), ran.stderr
    assert not [each for each in told if str(each) not in last], ran.stderr
