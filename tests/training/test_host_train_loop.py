import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.envs.base import HostEnvironment
from rewire_jax.envs.vector_env import VectorEnv, open_lanes
from rewire_jax.training import host_episodes, loop_state
from rewire_jax.training.run_setup import prepare
from tests import walk
from tests.loops import equal
from tests.walk_loop import begin, go, planned, settings

pytestmark = pytest.mark.usefixtures("one_core")


def close(one, other):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5), one, other
    )


@pytest.mark.parametrize(
    ("method", "color"),
    [
        ("ft1", 1.0),
        pytest.param("csp", 0.0, marks=pytest.mark.slow),
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


@pytest.mark.slow
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
    config = loop_state.LoopConfig(
        1, updates=7, warmup=10, random_steps=0, transitions=9, update_every=4
    )
    due = [steps for steps in range(1, 30) if config.due(steps)]
    assert due == [12, 16, 20, 24, 28]
    assert [config.before(steps) for steps in due] == [0, 7, 14, 21, 28]
    plan = planned(interactions=163)
    assert plan.budget.steps == 160  # a task ends with updates


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
