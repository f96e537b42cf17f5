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
from rewire_jax.run import run_state, sweep_grid, train_run
from rewire_jax.storage import run_folder
from rewire_jax.training import run_setup
from tests.small_sweep import rows, run_sweep, small
from tests.tiny import flags

GRID: dict[str, list[float]] = {
    "modes": [1, 2, 3, 4],
    "alpha": [0, 1e-2],
    "beta": [0.1, 1, 10],
}


def command(out: Path, *more: str, most: int = 12) -> list[str]:
    """A sweep of the grid from the command line, in two batches."""
    words = [sys.executable, "-m", "rewire_jax.cli.main", "sweep", "probe/reach"]
    words += [*flags(small()), "--out", str(out), "--members-per-batch", str(most)]
    words += ["--k", *map(str, GRID["modes"]), "--alpha", *map(str, GRID["alpha"])]
    return [*words, "--axis", "beta", *map(str, GRID["beta"]), *more]


def run(words: list[str], **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        words, capture_output=True, text=True, env=os.environ | environment, check=False
    )


def near(ours: dict[tuple, dict], theirs: dict[tuple, dict]) -> None:
    """The same rows, with numbers that differ as float sums in another order."""
    assert ours.keys() == theirs.keys()
    for place, row in ours.items():
        assert row.keys() == theirs[place].keys()
        for name, value in row.items():
            other = theirs[place][name]
            if isinstance(value, float):
                other = pytest.approx(other, rel=2e-3, abs=2e-3)
            assert value == other, (place, name)


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
        leaves += jax.tree.leaves(run_state.read_kept(path, 1, prepared))
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
    assert not run_state.finished(folder / "task-001/batch-000", 1)
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
from tests.run.test_sweep import GRID, small

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


def test_there_must_be_a_sweep_to_join(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no sweep"):
        run_sweep(tmp_path / "none", small(), axes={"beta": [1, 2]}, join=True)


def begin(words: list[str]) -> subprocess.Popen[str]:
    pipe = subprocess.PIPE
    return subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True)


@pytest.mark.slow
def test_halving_keeps_the_best_configurations(tmp_path: Path) -> None:
    # Learning rates far apart, so that there is a better and a worse.
    settings = small(seeds=2, tasks=3, interactions=480)
    axis = {"lr_policy": [1e-5, 3e-3, 1e-4, 1e-3, 1e30]}
    options = {"axes": axis, "members_per_batch": 4}
    whole = rows(run_sweep(tmp_path / "whole", settings, **options))
    halved = rows(run_sweep(tmp_path / "halved", settings, **options, halving=2))
    chosen = [range(10)]
    for stage in (0, 1):
        scores = {}
        for configuration in {member // 2 for member in chosen[-1]}:
            seeds = [2 * configuration, 2 * configuration + 1]
            mine = [whole[stage, m, t] for m in seeds for t in range(stage + 1)]
            bad = sum(whole[stage, m, 0]["diverged"] for m in seeds)
            mean = -np.inf if bad == 2 else np.mean([row["choice"] for row in mine])
            scores[configuration] = (-bad, mean)
        best = sorted(scores, key=scores.__getitem__, reverse=True)
        best = best[: -(-len(best) // 2)]
        chosen.append([m for c in sorted(best) for m in (2 * c, 2 * c + 1)])
    assert [len(members) for members in chosen] == [10, 6, 4]
    for stage, members in enumerate(chosen):
        assert {place[1] for place in halved if place[0] == stage} == set(members)
    # The absurd one diverged, is marked, and is not among the best.
    assert whole[2, 8, 0]["diverged"]
    assert halved[0, 9, 0]["diverged"]
    assert 8 not in chosen[1]
    # Those that are left go on as if the others were there.
    near(halved, {place: whole[place] for place in halved})


def test_settings_that_make_no_sense_are_said(tmp_path: Path) -> None:
    for options, said in (
        ({}, "needs an axis"),
        ({"axes": {"beta": [1]}, "halving": 0}, "--halving"),
        ({"axes": {"beta": [1]}, "random": -1}, "--random"),
        ({"axes": {"beta": [1]}, "members_per_batch": -1}, "--members-per-batch"),
        ({"axes": {"beta": [1]}, "random": 2}, "1 of the configurations are the same"),
        ({"configurations": [{"beta": 1}, {"alpha": 1}]}, "the same settings"),
        ({"axes": {"hidden": [1]}}, "no sweep over 'hidden'"),
        ({"axes": {"beta": np.array([1, 1])}}, "1 of the configurations are the same"),
    ):
        with pytest.raises(UserError, match=said):
            run_sweep(tmp_path / "none", small(), **options)
    assert not (tmp_path / "none").exists()


def fails(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The command ends with 2 and one line that says what is wrong."""
    with pytest.raises(SystemExit) as stopped:
        main.main(words)
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1


def test_another_sweep_or_a_run_is_not_resumed(
    swept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for more, said in (
        ([], "holds another run"),
        (["--resume", "--halving", "2"], "other axes, seeds or halving"),
        (["--resume", "--seeds", "2"], "other settings: --seeds"),
        (["--resume", "--axis", "tau", "1", "2"], "other axes"),
    ):
        fails([*command(swept)[3:], *more], said, capsys)
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


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "sweep").touch()
    with pytest.raises(UserError, match=r"cannot write to .*task-000: Not a directory"):
        run_folder.make(tmp_path / "sweep" / "task-000")


def test_report_takes_a_sweep(swept: Path, tmp_path: Path) -> None:
    main.main(["report", str(swept), "--out", str(tmp_path)])
    for name in ("members.csv", "configurations.csv", "panels.png"):
        assert (tmp_path / name).read_bytes() == (swept / name).read_bytes()


def test_random_and_halved_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # K is kept; of four configurations two and one go on.
    words = command(tmp_path / "sweep", most=2)[3:]
    words = [*words[: words.index("--k")], "--k", "1", "--beta", "0.1", "10"]
    main.main([*words, "--random", "4", "--halving", "2"])
    assert "4 configurations" in " ".join(capsys.readouterr().out.split())
    header = json.loads((tmp_path / "sweep/settings.json").read_text())
    values = [member["values"] for member in header["members"]]
    assert {value["modes"] for value in values} == {1}
    assert len({value["beta"] for value in values}) == 4
    found = rows(tmp_path / "sweep")
    assert len({place[1] for place in found if place[0] == 0}) == 4
    assert len({place[1] for place in found if place[0] == 1}) == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--axis", "beta"], "--axis"),
        (["--axis", "beta", "1", "--beta", "2"], "beta is an axis twice"),
        (["--axis", "beta", "one"], "--axis"),
        (["--k", "1.5"], "--modes must be a whole number"),
        (["--k", "inf"], "--modes must be finite"),
        (["--random", "2", "--beta", "1", "nan"], "--beta must be finite"),
        (["--random", "2", "--k", "1.5", "4"], "--modes must be a whole number"),
        (["--beta", "1", "--beta", "2"], "beta is an axis twice"),
        (["--beta", "1", "--processes", "2"], "--processes"),
        (["--axis", "tau", "0"], "--tau must be above 0"),
        (["--random", "3", "--beta", "1", "2", "3"], "needs a range"),
        (["--method", "ft1", "--alpha", "1"], "no sweep over 'alpha'"),
        (["--beta", "1", "--resume"], "holds no sweep"),
    ],
)
def test_wrong_arguments_end_in_one_line(
    words: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = str(tmp_path / "sweep")
    fails(["sweep", "probe/reach", *words, "--out", out], said, capsys)
    assert not (tmp_path / "sweep").exists()
