import dataclasses
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.envs.base import HostEnvironment
from rewire_jax.envs.vector_env import VectorEnv, open_lanes
from rewire_jax.methods import find_method
from rewire_jax.run import interrupts, train_run
from rewire_jax.training import exploration, host_episodes, loop_state
from rewire_jax.training.presets import preset
from rewire_jax.training.run_setup import Plan, prepare
from tests import walk
from tests.tiny import PLAIN

EVERY = 4


@pytest.fixture(autouse=True)
def one_core(monkeypatch):
    """Simulators are made quickly where they share this process."""
    monkeypatch.setattr("rewire_jax.envs.vector_env._cores", lambda: 1)


def settings(method: str = "ft1", **changes) -> Settings:
    quick = preset(walk.scenario(walk.COMPILED), method, "quick")
    shape = {
        "interactions": 160,
        "envs": 1,
        "updates": 3,
        "update_every": EVERY,
        "warmup": 6,
        "random_interactions": 5,
        "eval_episodes": 3,
        "selection_episodes": 1,
        "report_every": 40,
        "checkpoint_every": 0,
    }
    sac = dataclasses.replace(quick.sac, hidden=12, depth=1, batch_size=8, **PLAIN)
    return dataclasses.replace(quick, sac=sac, **(shape | changes))


def planned(environment=None, method="ft1", **changes) -> Plan:
    environment = environment or walk.walker()
    return prepare(settings(method, **changes), walk.scenario(environment))


def begin(plan: Plan, index=0):
    active = np.ones(plan.num_slots, bool)
    learner = plan.program.init(plan.stacked)
    return plan.program.begin(plan.stacked, learner, active, index, walk.TASKS[index])


def go(plan: Plan, state, chunks, time=0, index=0):
    """The state after the chunks, and their reports; `state` survives."""
    state = jax.tree.map(jnp.copy, state)
    reports = []
    for steps in chunks:
        state, report = plan.program.chunk(
            plan.stacked, state, index, walk.TASKS[index], time, steps
        )
        time += steps
        reports.append(jax.tree.map(np.asarray, report))
    return state, reports


def close(one, other):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5), one, other
    )


def equal(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize(
    ("method", "color"),
    [
        ("ft1", 1.0),
        ("csp", 0.0),
        pytest.param("ft1", 0.0, marks=pytest.mark.slow),
        pytest.param("rewire", 0.0, marks=pytest.mark.slow),
    ],
)
def test_the_loop_does_what_the_compiled_one_does(method, color):
    made = settings(method, interactions=400)
    made = dataclasses.replace(
        made, sac=dataclasses.replace(made.sac, noise_color=color)
    )
    plans = [
        prepare(made, walk.scenario(environment))
        for environment in (walk.walker(), walk.COMPILED)
    ]
    results = [go(plan, begin(plan, 1), [20, 32], index=1) for plan in plans]
    (ours, ours_reports), (theirs, theirs_reports) = results
    close(ours.learner, theirs.learner)
    close(ours.collection.buffer, theirs.collection.buffer)
    close(ours.collection.extras, theirs.collection.extras)
    close(ours_reports, theirs_reports)
    assert ours_reports[1].updates == 8
    assert ours_reports[1].episodes >= 2
    assert abs(ours.collection.buffer.reward).sum() > 1
    for plan, (state, _) in zip(plans, results, strict=True):
        expected = plan.program.state_shape(
            plan.stacked,
            jax.eval_shape(plan.program.init, plan.stacked),
            np.ones(1, bool),
            0,
            walk.TASKS[0],
        )
        shapes = jax.tree.map(lambda x: (x.shape, x.dtype), (state, expected))
        assert shapes[0] == shapes[1]


def test_lanes_in_processes_do_what_one_process_does(monkeypatch):
    several = planned(walk.walker(0.5), envs=2, warmup=12)
    results = []
    for cores in (1, 2):
        monkeypatch.setattr(
            "rewire_jax.envs.vector_env._cores", lambda cores=cores: cores
        )
        open_lanes.cache_clear()
        results.append(go(several, begin(several), [16, 8]))
    equal(*results)
    open_lanes.cache_clear()


def test_a_member_does_what_it_would_do_alone():
    environment = walk.walker(0.5)
    crowd = planned(environment, seeds=2)
    together, _ = go(crowd, begin(crowd), [40])
    alone = planned(environment, seed=1)
    state, _ = go(alone, begin(alone), [40])
    close(jax.tree.map(lambda x: x[1:], together.learner), state.learner)
    close(
        jax.tree.map(lambda x: x[1:], together.collection.buffer),
        state.collection.buffer,
    )


@pytest.mark.parametrize("overlap", [False, True])
def test_chunks_do_not_matter_nor_what_was_played_between(overlap):
    plan = planned(walk.walker(0.5), overlap=overlap)
    start = begin(plan)
    whole, (report,) = go(plan, start, [48])
    begin(plan)  # the simulators start anew
    first, reports = go(plan, start, [20])
    # Eight steps into an episode; now something else is played, then other simulators.
    assert first.collection.episodes.steps == 8
    policies = plan.program.policies(plan.stacked, first.learner)
    keys = jax.random.split(jax.random.key(3), (1, 2))
    plan.program.rollout(plan.tasks, policies, keys, 2)
    second, more = go(plan, first, [20], time=20)
    open_lanes.cache_clear()
    third, last = go(plan, second, [8], time=40)
    equal(whole, third)
    episodes = sum(r.episodes for r in [*reports, *more, *last])
    assert episodes == report.episodes == 4
    np.testing.assert_allclose(
        sum(r.returns for r in [*reports, *more, *last]), report.returns, rtol=1e-5
    )


def test_environments_that_end_apart_are_recalled():
    # Many, so that some end while they play on for those that are recalled later.
    plan = planned(walk.walker(0.9), envs=9, warmup=36)
    start = begin(plan)
    whole, _ = go(plan, start, [8, 8, 8, 8])
    state, _ = go(plan, start, [8, 8])
    for done in (16, 24):
        assert len(set(state.collection.episodes.steps.ravel().tolist())) > 2
        open_lanes.cache_clear()
        state, _ = go(plan, state, [8], time=done)
    equal(whole, state)


def test_a_simulator_that_does_not_repeat_itself_is_told():
    plan = planned(walk.walker(0.5, noise=1e-3))
    state, _ = go(plan, begin(plan), [8])
    open_lanes.cache_clear()
    with pytest.raises(UserError, match="does not repeat the episode"):
        go(plan, state, [4], time=8)


def test_a_buffer_must_hold_the_episode_that_is_played():
    with pytest.raises(UserError, match=f"--buffer 5 is too short.*{walk.LENGTH}"):
        planned(buffer=5)
    assert prepare(settings(buffer=5), walk.scenario(walk.COMPILED))


def test_lanes_that_failed_are_not_used_again():
    environment = walk.walker(0.5)
    lanes = open_lanes(environment, 1)
    lanes.reset(0, [1])
    assert open_lanes(environment, 1) is lanes
    with pytest.raises(AssertionError):
        lanes.step(np.zeros((1, 2)))  # not float32
    assert open_lanes(environment, 1) is not lanes


def test_a_script_without_a_main_guard_is_told(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(Path.cwd())!r})\n"
        "from tests import walk\n"
        "import rewire_jax.envs.vector_env as lanes\n"
        "lanes._cores = lambda: 2\n"
        "lanes.open_lanes(walk.walker(), 2)\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode
    assert "if __name__ == '__main__':" in done.stderr.splitlines()[-1]


def test_every_episode_has_a_start_of_its_own():
    plan = planned(walk.walker(0.5))
    state, _ = go(plan, begin(plan), [40])
    buffer = jax.tree.map(lambda x: np.asarray(x)[0, :, 0], state.collection.buffer)
    seen = buffer.observation[:41]
    starts = seen[1:][(buffer.truncated | buffer.terminal)[:40]]
    assert len(starts) >= 3
    assert len(np.unique(starts, axis=0)) == len(starts)
    other = planned(walk.walker(0.5), seed=1)
    assert (begin(other).collection.buffer.observation[0, 0] != seen[0]).all()
    later = begin(plan, 1)
    assert (later.collection.buffer.observation[0, 0] != seen[0]).all()


def test_with_overlap_the_policy_before_the_last_updates_acts():
    plan = planned(walk.walker(0.5), overlap=True, random_interactions=0)
    states = [begin(plan)]
    for number in range(5):
        state, _ = go(plan, states[-1], [EVERY], time=EVERY * number)
        states.append(state)
    final = states[-1].collection.buffer
    member = jax.tree.map(lambda x: x[0], plan.stacked)
    key = jax.random.split(jax.random.fold_in(jax.random.fold_in(member.keys, 1), 0), 4)
    method = find_method("ft1").make(plan.spec, plan.settings.options)

    def acted(learner, time):
        step_key = jax.random.split(jax.random.fold_in(key[1], time))[0]
        action, _ = exploration.explore(
            exploration.sample_noise(step_key, jnp.asarray(time), (1, 2), 0, None),
            jax.tree.map(lambda x: x[0], (learner.params, learner.method_state)),
            (),
            final.observation[0, time],
            jnp.zeros(1, jnp.int32),
            method,
        )
        return action

    for number in (2, 3, 4):
        time = EVERY * number
        before, newest = states[number - 1].learner, states[number].learner
        mine = final.action[0, time]
        np.testing.assert_allclose(acted(before, time), mine, rtol=1e-4, atol=1e-5)
        if number > 2:  # by then there were updates between the two
            assert abs(acted(newest, time) - mine).max() > 1e-4
    plain = planned(walk.walker(0.5), random_interactions=0)
    state, _ = go(plain, begin(plain), [5 * EVERY])
    assert (state.collection.buffer.action[0, 16:20] != final.action[0, 16:20]).any()


def test_with_overlap_steps_and_updates_are_made_at_the_same_time(monkeypatch):
    """A simulator that waits for an update to be begun, and an update for its steps."""
    plan = planned(walk.walker(), overlap=True, interactions=80)
    state = begin(plan)
    state, _ = go(plan, state, [8])  # all is compiled
    submitted, stepped = [], []
    submit, step = ThreadPoolExecutor.submit, VectorEnv.step
    held = threading.Event()

    def slow_submit(self, function, *arguments):
        def held_back():
            # The updates are not begun before steps that need not wait for them.
            assert held.wait(60)
            return function(*arguments)

        submitted.append(len(stepped))
        held.clear()
        return submit(self, held_back)

    def counted(self, actions):
        stepped.append(len(submitted))
        if len(stepped) % EVERY == 0:
            held.set()
        return step(self, actions)

    monkeypatch.setattr(ThreadPoolExecutor, "submit", slow_submit)
    monkeypatch.setattr(VectorEnv, "step", counted)
    threading.Timer(30, held.set).start()
    began = time.monotonic()
    done = threading.Thread(target=go, args=(plan, state, [12]), kwargs={"time": 8})
    done.start()
    while len(stepped) < 3 * EVERY and time.monotonic() - began < 25:
        time.sleep(0.01)
    # All steps were made, though no update had been let through before its next ones.
    assert len(stepped) == 3 * EVERY
    held.set()
    done.join()
    assert submitted == [EVERY, 2 * EVERY, 3 * EVERY]


def test_rollouts_are_those_of_a_loop():
    environment = walk.walker(0.9)
    plan = planned(environment, seeds=2, seed=4)
    learner = plan.program.init(plan.stacked)
    # Policies that reach the goals, and run over the edge on the way to some.
    policies = plan.program.policies(plan.stacked, learner)
    policies = jax.tree.map(lambda x: 4 * x, policies)
    keys = jax.random.split(jax.random.key(5), (2, 2))
    count = 5  # for two lanes: the last wave has one to spare
    result = plan.program.rollout(plan.tasks, policies, keys, count)
    method = find_method("ft1").make(plan.spec, plan.settings.options)
    simulator = environment.make()
    for m, row, e in itertools.product(range(2), range(2), range(count)):
        task = walk.TASKS[row]
        words = [*np.asarray(jax.random.key_data(keys[m, row])), e]
        seed = int(np.random.SeedSequence(words).generate_state(1)[0])
        seen, _ = simulator.reset(seed=seed, options={"task": row})
        policy = jax.tree.map(lambda x, m=m, row=row: x[m, row], policies)
        total, solved, terminal, steps = 0.0, [], False, 0
        while steps < walk.LENGTH and not terminal:
            mean, _ = method.act(policy, seen * task.observation_mask)
            action = np.asarray(jnp.tanh(mean) * task.action_scale)
            seen, reward, terminal, _, info = simulator.step(action)
            total, steps = total + reward, steps + 1
            solved.append(info["success"])
        at = m, row, e
        np.testing.assert_allclose(result.returns[at], total, rtol=1e-4)
        assert result.lengths[at] == steps
        assert result.success.any[at] == any(solved)
        assert result.success.last[at] == solved[-1]
    assert 0 < result.success.any.sum() < result.success.any.size
    assert (result.lengths < walk.LENGTH).any()


def test_a_run_tells_of_success(tmp_path):
    made = settings(interactions=160)
    folder = train_run.train(
        made, tmp_path / "run", scenario=walk.scenario(walk.walker(0.5))
    )
    rows = [json.loads(x) for x in (folder / "results.jsonl").read_text().splitlines()]
    assert len(rows) == 3 * 2
    assert all(0 <= row["success_last"] <= row["success"] <= 1 for row in rows)
    table = (folder / "training.jsonl").read_text().splitlines()
    reports = [json.loads(line) for line in table]
    assert [row["interactions"] for row in reports] == [40, 80, 120, 160] * 2
    assert all("success" in row and "success_last" in row for row in reports)


@pytest.mark.slow
def test_a_killed_run_resumes_in_the_middle_of_an_episode(tmp_path):
    # Real simulators; the checkpoint lies within an episode of 200 steps.
    words = "continual_world/t3 --method ft1 --profile quick --tasks 2"
    words += " --interactions 2160 --warmup 200 --updates 2 --update-every 40"
    words += " --hidden 8 --batch-size 8 --report-every 120 --checkpoint-every 1240"
    words += " --eval-episodes 1"
    command = [sys.executable, "-m", "rewire_jax.cli.main", "train", *words.split()]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    one = subprocess.Popen([*command, "--out", str(whole)], stderr=subprocess.PIPE)
    process = subprocess.Popen([*command, "--out", str(killed)], stderr=subprocess.PIPE)
    table = killed / "training.jsonl"
    while process.poll() is None:
        # In the second task, past its checkpoint.
        if table.exists() and len(table.read_text().splitlines()) >= 18 + 12:
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.002)
    assert process.wait() == -signal.SIGKILL
    (kept,) = (killed / "checkpoints").glob("task-001-step-*")
    assert int(kept.name.rpartition("-")[2]) % 200 != 0
    resumed = [*command, "--out", str(killed), "--resume"]
    subprocess.run(resumed, check=True, capture_output=True)
    assert one.wait() == 0
    for name in ("results.jsonl", "training.jsonl"):
        assert (killed / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.parametrize(
    ("method", "overlap"),
    [
        ("ft1", True),
        pytest.param("rewire", True, marks=pytest.mark.slow),
        pytest.param("csp", False, marks=pytest.mark.slow),
    ],
)
def test_what_is_needed_within_a_task_is_saved(method, overlap, tmp_path, monkeypatch):
    made = settings(method, overlap=overlap, interactions=240, checkpoint_every=100)
    scenario = walk.scenario(walk.walker(0.5))
    whole = train_run.train(made, tmp_path / "whole", scenario=scenario)
    called = train_run.Run.chunk

    def stopping(self, now, task):
        if now.stage == 1 and now.steps == 120:
            raise KeyboardInterrupt
        return called(self, now, task)

    with monkeypatch.context() as patch:
        patch.setattr(train_run.Run, "chunk", stopping)
        with pytest.raises(interrupts.Stopped):
            train_run.train(made, tmp_path / "stopped", scenario=scenario)
    assert list((tmp_path / "stopped" / "checkpoints").glob("task-001-step-*"))
    open_lanes.cache_clear()
    resumed = train_run.train(
        made, tmp_path / "stopped", scenario=scenario, resume=True
    )
    for name in ("results.jsonl", "training.jsonl"):
        assert (resumed / name).read_bytes() == (whole / name).read_bytes()


def test_ctrl_c_leaves_the_simulators_until_all_is_saved(tmp_path):
    words = "continual_world/t3 --method ft1 --profile quick --tasks 1 --seeds 2"
    words += " --interactions 20000 --warmup 200 --updates 1 --update-every 40"
    words += " --hidden 8 --batch-size 8 --report-every 80 --checkpoint-every 0"
    words += f" --eval-episodes 1 --out {tmp_path / 'run'}"
    process = subprocess.Popen(
        [sys.executable, "-m", "rewire_jax.cli.main", "train", *words.split()],
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )
    table = tmp_path / "run" / "training.jsonl"
    while process.poll() is None and not table.exists():
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate()
    assert process.returncode == 130
    assert "Traceback" not in said
    assert "--resume" in said
    assert list((tmp_path / "run" / "checkpoints").glob("task-000-step-*"))


def test_success_in_a_chunk_is_that_of_the_episodes_which_ended():
    plan = planned(walk.walker(0.9), interactions=400)
    state, (report,) = go(plan, begin(plan), [96])
    buffer = jax.tree.map(lambda x: np.asarray(x)[0, :, 0], state.collection.buffer)
    solved = -buffer.reward[:96] < 0.09
    ended = (buffer.terminal | buffer.truncated)[:96]
    episodes = np.split(solved, np.flatnonzero(ended) + 1)[: ended.sum()]
    assert report.episodes == len(episodes)
    assert report.successes.any == sum(e.any() for e in episodes)
    assert report.successes.last == sum(e[-1] for e in episodes)
    assert 0 < report.successes.any < len(episodes)


def test_updates_follow_every_so_many_steps():
    shape = loop_state.LoopConfig(
        1, updates=7, warmup=10, random_steps=0, transitions=9, update_every=4
    )
    due = [steps for steps in range(1, 30) if shape.due(steps)]
    assert due == [12, 16, 20, 24, 28]
    assert [shape.before(steps) for steps in due] == [0, 7, 14, 21, 28]
    plan = planned(interactions=163)
    assert plan.budget.steps == 160  # a task ends with updates


def test_overlap_needs_something_to_overlap():
    with pytest.raises(UserError, match="--overlap"):
        planned(walk.COMPILED, overlap=True)


def test_seeds_are_told_apart():
    roots = np.array([[0, 1], [0, 2]], np.uint32)
    drawn = host_episodes.seeds(roots, np.array([[0, 0, 1], [0, 5, 1]]))
    assert drawn.shape == (2, 3)
    assert len(np.unique(drawn)) == 6
    np.testing.assert_array_equal(
        drawn, host_episodes.seeds(roots, np.array([[0, 0, 1], [0, 5, 1]]))
    )


def test_lanes_that_are_not_reset_go_on():
    lanes = VectorEnv(walk.walker(0.5), 1)
    lanes.reset(0, [4])
    first = lanes.step(np.zeros((1, 2), np.float32))
    assert isinstance(walk.walker(), HostEnvironment)
    np.testing.assert_array_equal(lanes.observation, first.observation)
    assert lanes.steps == 1
    lanes.reset(1, [9])
    assert (lanes.task, lanes.steps[0], lanes.seeds[0]) == (1, 0, 9)
