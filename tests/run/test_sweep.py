import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewire_jax
from rewire_jax.cli import main
from rewire_jax.core.errors import UserError
from rewire_jax.run import run_checkpoints, sweep_grid, train_run
from rewire_jax.training import run_setup
from tests.command_line import fails
from tests.small_sweep import GRID, near, rows, small, sweep_words


def command(out: Path, *more: str, most: int = 12) -> list[str]:
    words = sweep_words(out, *more, most=most)
    return [sys.executable, "-m", "rewire_jax.cli.main", *words]


def run(words: list[str], **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        words, capture_output=True, text=True, env=os.environ | environment, check=False
    )


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweeps") / "sweep"
    done = run(command(folder))
    assert done.returncode == 0, done.stderr
    assert "24 configurations" in " ".join(done.stdout.split())
    # Known before anything is compiled, and so said first.
    first, *later = done.stderr.splitlines()
    assert re.match(r"a member needs .* MB: learner .*; 24 members, 12 at a t", first)
    assert all("finished in" in line for line in later)
    for name in ("members.csv", "configurations.csv", "sweep.md", "panels.png"):
        assert str(folder / name) in done.stdout
        assert (folder / name).stat().st_size > 0
    return folder


def test_every_combination_is_a_member(swept: Path) -> None:
    header = json.loads((swept / "settings.json").read_text())
    values = [member["values"] for member in header["members"]]
    assert values == sweep_grid.grid(GRID)
    found = rows(swept)
    assert set(found) == {
        (stage, member, task)
        for stage in (-1, 0, 1)
        for member in range(24)
        for task in range(2)
    }
    for stage in (0, 1):
        batches = json.loads((swept / f"task-{stage:03d}/batches.json").read_text())
        assert batches == {
            "size": 12,
            "batches": [list(range(12)), list(range(12, 24))],
        }
    # What is chosen by and what is reported are other episodes of the same policy.
    same = sum(row["return"] == row["choice"] for row in found.values())
    assert same < len(found) / 10


def alone(numbers: range, swept: Path, tmp_path: Path) -> None:
    """Compares members of the sweep with runs of their settings."""
    together = rows(swept), rows(swept, "training.jsonl")
    for number in numbers:
        settings = sweep_grid.configure(small(), sweep_grid.grid(GRID)[number])
        assert settings.options.mode_slots == settings.options.modes
        folder = train_run.train(settings, tmp_path / str(number))
        for theirs, table in zip(
            together, ("results.jsonl", "training.jsonl"), strict=True
        ):
            lines = (folder / table).read_text().splitlines()
            ours = {}
            for row in map(json.loads, lines):
                rest = row["task"] if "task" in row else row["interactions"]
                ours[row["stage"], number, rest] = row | {"member": number}
            wanted = {place: row for place, row in theirs.items() if place[1] == number}
            # A run of its own has nothing to choose among.
            wanted = {
                place: {n: v for n, v in row.items() if n != "choice"}
                for place, row in wanted.items()
            }
            near(ours, wanted)
        observation = jnp.linspace(-1, 1, 20).reshape(10, 2)
        for stage, task in ((0, 0), (None, 1)):
            one = rewire_jax.load_policy(folder, task=task, stage=stage)
            among = rewire_jax.load_policy(swept, task=task, stage=stage, member=number)
            np.testing.assert_allclose(
                one(observation), among(observation), rtol=1e-3, atol=1e-3
            )


@pytest.mark.slow
def test_a_member_is_what_it_is_alone(swept: Path, tmp_path: Path) -> None:
    alone(range(3, 24, 13), swept, tmp_path)


@pytest.mark.slow
def test_every_member_is_what_it_is_alone(swept: Path, tmp_path: Path) -> None:
    alone(range(24), swept, tmp_path)


def kept(folder: Path) -> list[np.ndarray]:
    """All that is kept of all members at the end."""
    first = json.loads((folder / "task-001/batches.json").read_text())
    variants = [
        sweep_grid.configure(small(), values) for values in sweep_grid.grid(GRID)
    ]
    settings, members = sweep_grid.make_members(small(), sweep_grid.grid(GRID))
    assert len(members) == len(variants)
    leaves = []
    for number, batch in enumerate(first["batches"]):
        chosen = [members[n] for n in batch]
        prepared = run_setup.prepare(settings, members=chosen, num_slots=first["size"])
        path = folder / f"task-001/batch-{number:03d}"
        leaves += jax.tree.leaves(run_checkpoints.read_kept(path, 1, prepared))
    return leaves


@pytest.mark.slow
def test_a_killed_sweep_resumes_bit_for_bit(swept: Path, tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    process = subprocess.Popen(command(folder), stderr=subprocess.PIPE)
    table = folder / "task-001/batch-000/training.jsonl"
    while process.poll() is None:
        # In the middle of the second task, past its checkpoint, in the first batch.
        if table.exists() and len(table.read_text().splitlines()) >= 3 * 12:
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.002)
    assert process.wait() == -signal.SIGKILL
    assert not run_checkpoints.finished(folder / "task-001/batch-000", 1)
    done = run(command(folder, "--resume"))
    assert done.returncode == 0, done.stderr
    for path in swept.glob("task-*/batch-*/*.jsonl"):
        if path.name != "timing.jsonl":
            again = folder / path.relative_to(swept)
            assert again.read_bytes() == path.read_bytes()
    for ours, theirs in zip(kept(folder), kept(swept), strict=True):
        np.testing.assert_array_equal(ours, theirs)


COLLECTIVE = re.compile(r"all-reduce|all-gather|all-to-all|collective-permute")
DEVICES = """
import json, sys
import jax, jax.numpy as jnp
from jax.sharding import PartitionSpec as P
from rewire_jax.run import sweep_grid
from rewire_jax.training import run_setup
from tests.small_sweep import GRID, small

settings, members = sweep_grid.make_members(small(), sweep_grid.grid(GRID))
made = run_setup.prepare(settings, members=members)
learner = made.program.init(made.stacked)
task = jax.tree.map(lambda leaf: leaf[0], made.tasks)
active = jnp.ones(24, bool)
state = made.program.begin(made.stacked, learner, active, 0, task)
chunk = made.program.chunk.lower(made.stacked, state, 0, task, 0, 20)
whole = jax.shard_map(
    lambda x: jax.lax.psum(x, "members"), mesh=made.mesh, in_specs=P("members"),
    out_specs=P(),
)
print(json.dumps({
    "devices": [str(s.data.shape[0]) for s in state.active.addressable_shards],
    "chunk": chunk.compile().as_text(),
    "control": jax.jit(whole).lower(jnp.ones(24)).compile().as_text(),
}))
"""
EIGHT = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"


@pytest.mark.slow
def test_devices_train_their_members_without_a_word_to_each_other(
    swept: Path, tmp_path: Path
) -> None:
    done = run(command(tmp_path / "sweep", most=24), XLA_FLAGS=EIGHT)
    assert done.returncode == 0, done.stderr
    near(rows(tmp_path / "sweep"), rows(swept))
    compiled = run([sys.executable, "-c", DEVICES], XLA_FLAGS=EIGHT)
    assert compiled.returncode == 0, compiled.stderr
    found = json.loads(compiled.stdout)
    assert found["devices"] == ["3"] * 8
    assert not COLLECTIVE.search(found["chunk"])
    # The search does find one where there is one.
    assert COLLECTIVE.search(found["control"])


@pytest.mark.slow
def test_two_processes_share_the_batches(swept: Path, tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    processes = [begin(command(folder))]
    while not (folder / "settings.json").exists():
        assert processes[0].poll() is None
        time.sleep(0.1)
    processes.append(begin([*command(folder), "--join"]))
    said = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    # Of two batches of each task, each was trained once, by whoever was free.
    batches = [error.count("finished in") for _, error in said]
    assert sum(batches) == 2 * 2
    assert "sweep.md" in said[0][0]
    assert "sweep.md" not in said[1][0]
    near(rows(folder), rows(swept))


@pytest.mark.slow
def test_who_joins_finishes_what_another_process_left(
    swept: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "sweep"
    first = begin(command(folder))
    while not list(folder.glob("task-000/batch-000/checkpoints/*-step-*")):
        assert first.poll() is None
        time.sleep(0.1)
    first.kill()
    first.communicate()
    done = run([*command(folder), "--join"])
    assert done.returncode == 0, done.stderr
    near(rows(folder), rows(swept))


def begin(words: list[str]) -> subprocess.Popen[str]:
    pipe = subprocess.PIPE
    return subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True)


def test_another_sweep_or_a_run_is_not_resumed(
    swept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for more, said in (
        ([], "holds another run"),
        (["--resume", "--halving", "2"], "other axes, seeds or halving"),
        (["--resume", "--seeds", "2"], "other settings: --seeds"),
        (["--resume", "--axis", "tau", "1", "2"], "other axes"),
    ):
        assert said in fails(capsys, *sweep_words(swept), *more)
    for wrong, said in (
        ({"task": 0}, "give member"),
        ({"task": 0, "member": 24}, "no member 24"),
        ({"task": 2, "member": 0}, "tasks 0 to 1"),
        ({"task": 0, "member": 0, "stage": 2}, "not been trained on task 2"),
    ):
        with pytest.raises(UserError, match=said):
            rewire_jax.load_policy(swept, **wrong)
    with pytest.raises(UserError, match=r"holds a sweep, .* load_policy"):
        rewire_jax.load_policies(swept)
    with pytest.raises(UserError, match=r"holds a sweep: .* load_policy"):
        rewire_jax.evaluate(swept)


def test_report_takes_a_sweep(swept: Path, tmp_path: Path) -> None:
    main.main(["report", str(swept), "--out", str(tmp_path)])
    for name in ("members.csv", "configurations.csv", "panels.png"):
        assert (tmp_path / name).read_bytes() == (swept / name).read_bytes()
