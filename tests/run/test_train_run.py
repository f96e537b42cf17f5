import dataclasses
import itertools
import json
import os
import shutil
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
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.scenarios import ScenarioSpec, make_scenario
from rewire_jax.reports.write import write_report
from rewire_jax.run import train_run
from rewire_jax.storage import checkpoint
from rewire_jax.training import run_setup
from tests.compiles import assert_once, compiles
from tests.stopped_run import (
    TABLES,
    assert_same_run,
    assert_same_tables,
    checkpoints,
    train_until,
)
from tests.tiny import flags, rows, tiny


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    return train_run.train(tiny(), folder, log=["tensorboard"])


def test_every_task_is_evaluated_after_every_task(run: Path) -> None:
    places = [(row["stage"], row["task"], row["seed"]) for row in rows(run)]
    expected = [(s, t, m) for s in range(-1, 4) for m in range(2) for t in range(4)]
    assert sorted(places) == sorted(expected)
    assert checkpoints(run) == [f"task-{task:03d}" for task in (1, 2, 3, 4)]
    last = rows(run)[-1]
    assert last["interactions"]["training"] == 4 * 640
    # Two episodes of each of three modes at start and end of each of four tasks.
    steps = make_scenario("probe/reach").environment.episode_length
    assert last["interactions"]["selection"] == 2 * 4 * 3 * 2 * steps
    assert len({row["return"] for row in rows(run)}) > 10
    assert list((run / "tensorboard").glob("seed-*/events*"))
    report = write_report([run], run / "report")
    assert all(path.exists() for path in report.paths)


@pytest.mark.slow
def test_a_killed_run_resumes_bit_for_bit(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    words = [sys.executable, "-m", "rewire_jax.cli.main", "train", "probe/reach"]
    words += ["--out", str(folder), *flags(tiny())]
    process = subprocess.Popen(words, stderr=subprocess.PIPE)
    table = folder / "training.jsonl"
    while process.poll() is None:
        # In the middle of the second task, past its full checkpoint.
        if table.exists() and len(table.read_text().splitlines()) >= 2 * (4 + 2):
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.002)
    assert process.wait() == -signal.SIGKILL
    assert checkpoints(folder)[-1] != "task-004"
    subprocess.run([*words, "--resume"], check=True, capture_output=True)
    assert_same_run(folder, run, tiny())


def test_a_run_may_be_older_than_a_setting(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    header = json.loads((copy / "settings.json").read_text())
    for name in ("noise_color", "network"):
        del header["settings"]["sac"][name]
    del header["spec"]["network"]
    (copy / "settings.json").write_text(json.dumps(header))
    train_run.train(tiny(), copy, resume=True)
    seen = jnp.array([0.3, -0.2])
    actions = [rewire_jax.load_policy(folder, task=3)(seen) for folder in (run, copy)]
    np.testing.assert_array_equal(*actions)
    for change, says in (
        ({"noise_color": 1.0}, r"--noise-color was 0\.0, not 1\.0"),
        ({"network": "layer_norm"}, "--network"),
    ):
        sac = dataclasses.replace(tiny().sac, **change)
        with pytest.raises(UserError, match=says):
            train_run.train(dataclasses.replace(tiny(), sac=sac), copy, resume=True)


@pytest.mark.parametrize(
    ("chunks", "damaged"),
    [
        (7, 2),
        (1, 0),
        pytest.param(7, 1, marks=pytest.mark.slow),
        pytest.param(4, 1, marks=pytest.mark.slow),
    ],
)
def test_a_damaged_checkpoint_falls_back_to_the_one_before(
    run: Path,
    tmp_path: Path,
    chunks: int,
    damaged: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    train_until(monkeypatch, tiny(), tmp_path / "run", chunks)
    found = checkpoint.available(tmp_path / "run" / "checkpoints")
    for path in found[:damaged]:
        largest = max(path.rglob("*"), key=lambda f: f.stat().st_size * f.is_file())
        os.truncate(largest, largest.stat().st_size // 2)
    train_run.train(tiny(), tmp_path / "run", resume=True)
    assert capsys.readouterr().err.count("falling back") == min(damaged, len(found))
    assert_same_run(tmp_path / "run", run, tiny())


@pytest.mark.parametrize("table", TABLES)
def test_a_table_that_lost_rows_is_written_again(
    run: Path, tmp_path: Path, table: str, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    lines = (copy / table).read_text().splitlines(keepends=True)
    (copy / table).write_text("".join(lines)[:-3])
    train_run.train(tiny(), copy, resume=True)
    assert f"{table} has lost or foreign rows" in capsys.readouterr().err
    assert_same_tables(copy, run)
    assert checkpoints(copy) == checkpoints(run)


@pytest.mark.slow
def test_one_trace_for_an_eight_task_scenario(tmp_path: Path) -> None:
    changes = [
        TaskChange(name, extra={"goal": goal})
        for name, goal in {"a": (1, 1), "b": (-1, 1), "c": (0, -1), "d": (1, 0)}.items()
    ]
    spec = ScenarioSpec("probe/eight", "reach", tuple(changes), 2, 640)
    scenario = make_scenario(spec)
    # A width of its own, so that no other test has compiled the same.
    settings = tiny(scenario)
    settings = dataclasses.replace(
        settings, tasks=8, sac=dataclasses.replace(settings.sac, hidden=12)
    )
    with compiles() as counts:
        train_run.train(settings, tmp_path / "run", scenario=scenario)
    assert_once(counts, "candidates")
    # Evaluation; selection of each of three modes.
    assert counts["episodes"] == 2
    assert len(rows(tmp_path / "run")) == 9 * 8 * 2


def test_policies_load_from_the_folder_alone(run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "elsewhere"
    subprocess.run(["cp", "-r", str(run), str(copy)], check=True)
    prepared = run_setup.prepare(tiny())
    environment = prepared.scenario.environment
    for task, seed in ((0, 0), (2, 1)):
        policy = rewire_jax.load_policy(copy, task=task, seed=seed)
        with pytest.raises(AssertionError):
            policy(jnp.zeros(prepared.spec.observations + 1))
        one = jnp.asarray([0.3, -0.2])
        many = jnp.stack([one, -one, 2 * one])
        single = jax.jit(policy)(one)
        assert single.shape == (2,)
        np.testing.assert_allclose(jax.vmap(policy)(many)[0], single, atol=1e-6)
        np.testing.assert_allclose(policy(many)[0], single, atol=1e-6)
        # It plays as the run's own evaluation says.
        data = prepared.scenario.tasks[task].data
        saved = [
            row["return"]
            for row in rows(run)
            if (row["stage"], row["task"], row["seed"]) == (3, task, seed)
        ]
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 2), 4)
        keys = jax.random.split(jax.random.fold_in(key, task), 4)

        def play(key, policy=policy, data=data):
            state = environment.reset(data, key)

            def step(carry, _):
                state, total = carry
                state = environment.step(data, state, policy(state.observation))
                return (state, total + state.reward), None

            carry = (state, jnp.zeros(()))
            return jax.lax.scan(step, carry, length=environment.episode_length)[0][1]

        assert np.mean(jax.vmap(play)(keys)) == pytest.approx(saved[0], rel=1e-4)
    earlier = rewire_jax.load_policy(copy, task=0, stage=0)
    assert not np.allclose(earlier(one), rewire_jax.load_policy(copy, task=0)(one))
    for wrong in ({"task": 9}, {"task": 0, "seed": 7}, {"task": 0, "stage": 8}):
        with pytest.raises(UserError):
            rewire_jax.load_policy(copy, **wrong)


@pytest.mark.parametrize("stage", [None, 1])
def test_all_policies_are_one_function_of_what_was_learned(run: Path, stage) -> None:
    policies = rewire_jax.load_policies(run, stage=stage)
    assert policies.seeds == (0, 1)
    assert len(policies.tasks) == 4
    observations = jax.random.normal(jax.random.key(0), (2, 4, 3, 2))
    over_tasks = jax.vmap(policies.act, (None, 0, 0))
    over_all = jax.jit(jax.vmap(over_tasks, (0, None, 0)))
    actions = over_all(policies.members, jnp.arange(4), observations)
    for seed, task in itertools.product(range(2), range(4)):
        one = rewire_jax.load_policy(run, task=task, seed=seed, stage=stage)
        np.testing.assert_allclose(
            actions[seed, task], one(observations[seed, task]), atol=1e-6
        )


def test_what_is_learned_can_be_taken_apart(run: Path) -> None:
    policies = rewire_jax.load_policies(run)
    first = jax.tree.map(lambda leaf: leaf[0], policies.members)
    orders = first.method_state.orders
    np.testing.assert_array_equal(
        np.sort(orders, axis=-1), np.broadcast_to(np.arange(16), orders.shape)
    )
    # Whoever has another task's wiring acts otherwise.
    exchanged = first._replace(
        method_state=first.method_state._replace(orders=orders[::-1])
    )
    seen = jnp.array([0.3, -0.2])
    assert not np.allclose(
        policies.act(first, 0, seen), policies.act(exchanged, 0, seen), atol=1e-4
    )
    with pytest.raises(UserError, match="no checkpoint of task 8"):
        rewire_jax.load_policies(run, stage=8)


def test_evaluate_replays_a_run(run: Path) -> None:
    played = rewire_jax.evaluate(run, episodes=64)
    final = {(r["task"], r["seed"]): r["return"] for r in rows(run) if r["stage"] == 3}
    assert len(played) == len(final)
    for row in played:
        # Other episodes, same policy: within the spread of the run's four episodes.
        spread = 4 * row["std"] / 2
        assert abs(row["return"] - final[row["task"], row["seed"]]) < spread


def test_evaluate_without_task_labels(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labelled = rewire_jax.evaluate(run, episodes=8)
    how = {"task_label": "none", "trials": 2, "trial_steps": 10}
    played = rewire_jax.evaluate(run, episodes=8, **how)
    choices = [row.pop("chosen") for row in played]
    assert played == labelled
    for row, chosen in zip(labelled, choices, strict=True):
        assert chosen["recognised"] == (chosen["task"] == row["task"])
        # The same policy plays the same episodes alike; another one does not.
        assert (chosen["return"] == row["return"]) == chosen["recognised"]
        assert chosen["candidates"] == 4
        assert chosen["interactions"] == (4 + 2) * 2 * 10
    words = ["--task-label", "none", "--trials", "2", "--trial-steps", "10"]
    main.main(["evaluate", str(run), "--episodes", "8", *words])
    said = capsys.readouterr().out
    share = np.mean([chosen["recognised"] for chosen in choices])
    assert f" {share:.0%} of the tasks" in said
    assert said.count("yes") == sum(chosen["recognised"] for chosen in choices)
    # After the first task, its policy is the only one.
    first = rewire_jax.evaluate(run, episodes=8, stage=0, **how)
    assert [row["chosen"]["recognised"] for row in first] == 2 * [True, *[None] * 3]
    assert not any(row["chosen"]["interactions"] for row in first)


def test_a_policy_for_an_unknown_task_is_chosen_by_its_returns(run: Path) -> None:
    policies = rewire_jax.load_policies(run)
    played = []

    def play(task: int) -> float:
        played.append(task)
        return -abs(task - 2.2)

    assert policies.choose(policies.member(1), play, trials=3) == 2
    assert played == [0] * 3 + [1] * 3 + [2] * 3 + [3] * 3 + [2] * 3 + [3] * 3
    early = rewire_jax.load_policies(run, stage=1)
    assert early.candidates(early.member(0)) == (0, 1)
    with pytest.raises(UserError, match="trials"):
        policies.choose(policies.member(1), play, trials=0)


def test_a_frozen_seed_is_marked_and_the_other_goes_on(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    begin = train_run.Run.begin

    def poisoned(self, now, task):
        now = begin(self, now, task)
        if now.stage == 1:
            learner = now.state.learner
            critic = jax.tree.map(lambda x: x.at[0].set(jnp.nan), learner.critic)
            state = now.state._replace(learner=learner._replace(critic=critic))
            now = now._replace(state=state)
        return now

    monkeypatch.setattr(train_run.Run, "begin", poisoned)
    train_run.train(tiny(), tmp_path / "run")
    marked = {(r["stage"], r["seed"]) for r in rows(tmp_path / "run") if r["diverged"]}
    assert marked == {(1, 0), (2, 0), (3, 0)}
    # `evaluate` names it, too.
    main.main(["evaluate", str(tmp_path / "run"), "--episodes", "1"])
    said = capsys.readouterr().out.splitlines()
    assert [line[:6] for line in said if "diverged" in line] == ["seed 0"]
    # The other seed is what it was, but for the order of float sums.
    for ours, theirs in zip(rows(tmp_path / "run"), rows(run), strict=True):
        if ours["seed"] == 1:
            assert ours["return"] == pytest.approx(theirs["return"], rel=1e-3)
