"""What lies in a run folder is never executed, and harms nobody who reads it."""

import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

import rewire_jax
from experiments.faults.hostile import FILES, VALUES, Trap
from rewire_jax.cli import main
from rewire_jax.storage.run_results import read_run
from tests.cli.test_cli import TINY

TRAPS = (*FILES, *VALUES)
_TASKS = ["--tasks", "3", "--checkpoint-every", "160"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile") / "run"
    main.main(["train", "probe/reach", "--out", str(folder), *TINY, *_TASKS])
    return folder


@pytest.fixture(autouse=True)
def impatient() -> Iterator[None]:
    """What waits for ever, as for a pipe that nobody writes to, fails."""

    def stop(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("trap", TRAPS, ids=[trap.name for trap in TRAPS])
def test_a_trap_is_an_error_in_one_line(trap: Trap, run: Path, tmp_path: Path) -> None:
    folder, marker = tmp_path / "run", tmp_path / "marker"
    shutil.copytree(run, folder)
    trap.spring(folder, marker)
    told = []
    for read in (
        read_run,
        rewire_jax.load_policies,
        lambda folder: rewire_jax.load_policy(folder, task=0),
        lambda folder: rewire_jax.evaluate(folder, episodes=2),
    ):
        try:
            read(folder)
        except rewire_jax.UserError as error:
            told.append(str(error))
    assert not marker.exists()
    assert told or trap.harmless
    assert not any("\n" in line for line in told)
