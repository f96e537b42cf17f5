"""Meta-World on MJX-Warp against C MuJoCo, along recorded episodes of experts.

Needs MTCWorldMJX: `make test-mjx`. `python -m experiments.record_experts` made the
recordings. To read the tolerances by: positions are in metres, of which a hand moves
0.01 in a step, and rewards go from 0 to 10.
"""

import dataclasses
import importlib.util
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import rewire_jax
from rewire_jax.core.errors import UserError
from rewire_jax.envs import metaworld
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.scenarios import make_scenario

installed = pytest.mark.skipif(
    importlib.util.find_spec("MTCWorldMJX") is None, reason="make test-mjx runs it"
)
NAMES = ("faucet-close", "handle-press-side", "push", "window-close")
FOLDER = Path(__file__).parents[1] / "data" / "metaworld"
STATES = 48  # of an episode; a step is predicted from each
SIMULATED = ("qpos", "qvel", "qacc_warmstart", "mocap_pos")
HANDLE_START = "window_handle_pos_init"
POSITIONS = [0, 1, 2, 4, 5, 6]
GOAL = slice(-3, None)
TRACES = []


def load(name):
    with np.load(FOLDER / f"{name}.npz") as recording:
        return dict(recording)


def drawn(vector):
    """A simulation's way to draw its start that always draws this one."""
    return lambda self, key: self.reset_state_from_rand_vec(jnp.asarray(vector))


@pytest.fixture(scope="module")
def replayed():
    """What the compiled environment makes of each recording.

    For each task `first`, the observation after a reset to the recorded start;
    `chosen`, indices of states, with the steps predicted from these; `free`, the
    recorded actions played without a look at the recording, and `last`, the scene
    some steps after these.
    """
    import MTCWorldMJX

    from rewire_jax.envs.metaworld_mjx import make_simulator

    recordings = {name: load(name) for name in NAMES}
    domain = metaworld.make_domain("mjx", "v2", NAMES)
    environment = domain.environment

    @jax.jit
    def reset(task):
        TRACES.append("reset")
        return environment.reset(task, jax.random.key(0))

    @jax.jit
    def forced(task, states, actions):
        TRACES.append("forced")
        step = jax.vmap(lambda state, action: environment.step(task, state, action))
        return step(states, actions)

    @jax.jit
    def free(task, state, actions):
        def step(state, action):
            TRACES.append("free")
            state = environment.step(task, state, action)
            return state, state._replace(inner=())

        return jax.lax.scan(step, state, actions)

    def replay(name, recording):
        task = domain.make_task(TaskChange(name, extra={"task": name}))
        state = reset(task)
        zeros, unravel = ravel_pytree(make_simulator(name).scene)

        def packed(scene):
            vector, _ = ravel_pytree(scene)
            return jnp.pad(vector, (0, len(state.inner) - len(vector)))

        scene = unravel(state.inner[: len(zeros)])
        if HANDLE_START in recording:
            scene.info[HANDLE_START] = jnp.asarray(recording[HANDLE_START])
        length = len(recording["actions"])
        chosen = np.linspace(0, length - 1, STATES).astype(int)

        def at(index):
            data = {field: recording[field][index] for field in SIMULATED}
            seen = recording["observations"][index, :18]
            return packed(
                scene._replace(
                    data=scene.data | data, info=scene.info | {"prev_obs": seen}
                )
            )

        states = jax.tree.map(lambda leaf: jnp.stack([leaf] * STATES), state)
        states = states._replace(inner=jnp.stack([at(index) for index in chosen]))
        longest = max(len(other["actions"]) for other in recordings.values())
        actions = np.pad(recording["actions"], ((0, longest - length), (0, 0)))
        last, played = free(task, state._replace(inner=packed(scene)), actions)
        return {
            "first": np.asarray(state.observation),
            "chosen": chosen,
            "forced": forced(task, states, recording["actions"][chosen]),
            "free": jax.tree.map(lambda leaf: np.asarray(leaf[:length]), played),
            "last": unravel(last.inner[: len(zeros)]),
        }

    with pytest.MonkeyPatch.context() as patch:
        for name, recording in recordings.items():
            simulated = MTCWorldMJX.ENV_CLS_MAP[f"{name}-v3"]
            patch.setattr(simulated, "sample_reset_state", drawn(recording["rand_vec"]))
        return {name: replay(name, recordings[name]) for name in NAMES}


@installed
def test_one_compilation_serves_all_tasks(replayed):
    assert sorted(TRACES) == ["forced", "free", "reset"]


@installed
@pytest.mark.parametrize("name", NAMES)
def test_a_reset_shows_what_metaworld_shows(replayed, name):
    error = np.abs(replayed[name]["first"] - load(name)["observations"][0])
    if name == "window-close":
        # Metaworld's first observation still has the handle of an earlier draw.
        error[[4, 5, 6, 22, 23, 24]] = 0
    assert error.max() < 1e-3


@installed
@pytest.mark.parametrize("name", NAMES)
def test_single_steps_observe_what_metaworld_observes(replayed, name):
    recording, chosen = load(name), replayed[name]["chosen"]
    seen = np.asarray(replayed[name]["forced"].observation)
    before = recording["observations"][chosen]
    after = recording["observations"][chosen + 1]
    error = np.abs(seen - after)
    assert error.max() < 1e-2  # the gripper's opening and quaternions, in contact
    assert error[:, POSITIONS].max() < 4e-3
    moved = np.abs(after - before)[:, POSITIONS].max(1)
    assert np.median(error[:, POSITIONS].max(1)) < 0.1 * np.median(moved)
    assert (np.abs(after[:, GOAL]).max(1) > 0.05).all()
    assert error[:, GOAL].max() < 1e-3


@installed
@pytest.mark.parametrize("name", NAMES)
def test_single_steps_pay_what_metaworld_pays(replayed, name):
    recording, chosen = load(name), replayed[name]["chosen"]
    predicted = replayed[name]["forced"]
    error = np.abs(np.asarray(predicted.reward) - recording["rewards"][chosen])
    assert np.median(error) < 0.01
    # A reward jumps where a distance passes its threshold.
    assert (error > 0.2).sum() <= 2
    wrong = np.asarray(predicted.success) != recording["successes"][chosen]
    assert wrong.sum() <= 1
    assert not np.asarray(predicted.terminal).any()


@installed
@pytest.mark.parametrize("name", NAMES)
def test_an_episode_takes_its_course_and_succeeds_in_time(replayed, name):
    recording, played = load(name), replayed[name]["free"]
    error = np.abs(played.observation - recording["observations"][1:])
    assert error[:, POSITIONS].max() < 0.03
    assert abs(played.success.argmax() - recording["successes"].argmax()) <= 2
    assert played.success.any()
    assert played.reward.sum() == pytest.approx(recording["rewards"].sum(), rel=0.07)


@installed
@pytest.mark.parametrize("name", NAMES)
def test_what_can_be_hit_is_where_the_scene_has_it(replayed, name):
    import MTCWorldMJX
    import mujoco

    scene = replayed[name]["last"]
    path = MTCWorldMJX.ENV_CLS_MAP[f"{name}-v3"].xml_path.fget(None)
    model = mujoco.MjModel.from_xml_path(str(path))
    asmade = model.body_pos.copy()
    model.body_pos[:] = scene.model["body_pos"]
    data = mujoco.MjData(model)
    for field in ("qpos", "mocap_pos", "mocap_quat"):
        getattr(data, field)[:] = scene.data[field]
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(scene.data["geom_xpos"], data.geom_xpos, atol=1e-4)
    if name != "push":  # which places no body that is fixed to the world
        assert np.abs(model.body_pos - asmade).max() > 1e-2


@installed
def test_starts_are_drawn_anew_and_by_the_key():
    domain = metaworld.make_domain("mjx", "v2", ("faucet-close",))
    task = domain.make_task(TaskChange("it", extra={"task": "faucet-close"}))
    keys = jax.random.split(jax.random.key(0), 3)[jnp.asarray([0, 1, 0, 2])]
    reset = jax.jit(jax.vmap(domain.environment.reset, (None, 0)))
    seen = np.asarray(reset(task, keys).observation)
    np.testing.assert_array_equal(seen[0], seen[2])
    for one, other in ((0, 1), (0, 3), (1, 3)):
        assert np.abs(seen[one, GOAL] - seen[other, GOAL]).max() > 1e-3


@installed
@pytest.mark.slow
def test_a_run_learns_over_the_end_of_an_episode(tmp_path):
    scenario = make_scenario("continual_world/t3", "mjx", "v2")
    quick = rewire_jax.preset(scenario, "ft1", "quick")
    settings = dataclasses.replace(
        quick,
        tasks=1,
        interactions=300,
        warmup=100,
        random_interactions=100,
        eval_episodes=1,
        report_every=300,
        checkpoint_every=0,
        sac=dataclasses.replace(quick.sac, hidden=16, depth=1, batch_size=8),
    )
    rewire_jax.train(settings, tmp_path / "run", scenario=scenario)
    lines = (tmp_path / "run" / "results.jsonl").read_text().splitlines()
    before, after = (json.loads(line) for line in lines)
    assert before["interactions"]["training"] == 0
    assert after["interactions"]["training"] == 300
    for row in before, after:
        assert 0 < row["return"] < 2000
        assert row["success_last"] <= row["success"] <= 1
    (line,) = (tmp_path / "run" / "training.jsonl").read_text().splitlines()
    assert 0 < json.loads(line)["return"] < 2000


@installed
def test_there_is_no_reward_v1():
    with pytest.raises(UserError, match="--reward v2"):
        metaworld.make_domain("mjx", "v1", ("push",))


@installed
def test_an_unknown_task_is_named():
    with pytest.raises(UserError, match="'pull'"):
        metaworld.make_domain("mjx", "v2", ("pull",))


def test_a_missing_package_is_told_in_one_line(monkeypatch):
    monkeypatch.delitem(sys.modules, "rewire_jax.envs.metaworld_mjx", raising=False)
    monkeypatch.setitem(sys.modules, "MTCWorldMJX", None)
    with pytest.raises(UserError, match=r"make setup-mjx.*rewire_jax\[cw-mjx\]"):
        metaworld.make_domain("mjx", "v2", ("push",))
