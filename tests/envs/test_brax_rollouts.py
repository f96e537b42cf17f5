import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.envs import brax as domains
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.scenarios import SCENARIOS

STEPS = 20
LANES = 8
KEY = jax.random.key(3)
# These programs run for milliseconds: spend no time on making them fast.
QUICK = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
# What each domain is rolled out on unless a test is about the backend.
BACKEND = {"halfcheetah": "spring", "ant": "positional"}
TRACES: list[tuple[str, str]] = []
ROLLS = {}
# In the order of the positions q[7:].
JOINTS = [f"{joint}_{leg}" for leg in (1, 2, 3, 4) for joint in ("hip", "ankle")]
ANT = {
    change.name: change
    for spec in SCENARIOS.values()
    if spec.domain == "ant"
    for change in spec.changes
}


def roll(domain, task, actions, backend=None):
    """Acts for STEPS from one key; actions broadcast to [LANES, STEPS, actions].

    Returns q [LANES, STEPS, q], observations, rewards and terminals.
    """
    backend = backend or BACKEND[domain]
    environment = domains.make_domain(domain, backend).environment

    def one(task, key, actions):
        TRACES.append((domain, backend))

        def step(state, action):
            state = environment.step(task, state, action)
            return state, (state.inner.q, *state[1:])

        first = environment.reset(task, key)
        return jax.lax.scan(step, first, actions)[1]

    if (domain, backend) not in ROLLS:
        ROLLS[domain, backend] = jax.jit(
            jax.vmap(one, in_axes=(None, None, 0)), compiler_options=QUICK
        )
    actions = jnp.broadcast_to(
        jnp.asarray(actions, jnp.float32), (LANES, STEPS, environment.action_size)
    )
    out = ROLLS[domain, backend](task, KEY, actions)
    return [np.asarray(x) for x in out]


def make_task(domain, backend=None, /, **change):
    backend = backend or BACKEND[domain]
    make = domains.make_domain(domain, backend).make_task
    return make(TaskChange("changed", **change))


def edit(task, **leaves):
    return task._replace(physics=task.physics.tree_replace(leaves))


def floating(task, height):
    """The same task, started in the air; HalfCheetah's z is q[1], else q[2]."""
    z = 1 if task.physics.link_types[0] == "3" else 2
    return edit(task, init_q=task.physics.init_q.at[z].add(height))


def weightless(task):
    zero = jnp.zeros(3)
    return edit(floating(task, 3.0), **{"gravity": zero, "opt.gravity": zero})


def check_free_fall(domain, backend, z):
    """At 0.15 of gravity, 0.15 of the fall: what is left at 0 is the start's."""
    none, moon, full = (
        roll(domain, floating(make_task(domain, backend, gravity=g), 9.0), 0, backend)
        for g in (0.0, 0.15, 1.0)
    )
    fall, slow = (
        full[0][0, :, z] - none[0][0, :, z],
        moon[0][0, :, z] - none[0][0, :, z],
    )
    # Semi-implicit Euler; later on, HalfCheetah's joints to the world brake it.
    h = float(make_task(domain, backend).physics.opt.timestep)
    n = np.round(0.05 * np.arange(1, 5) / h)
    np.testing.assert_allclose(fall[:4], -9.81 * h**2 * n * (n + 1) / 2, rtol=0.1)
    np.testing.assert_allclose(slow, 0.15 * fall, rtol=0.05)


def push(domain, backend, factor):
    """How far the first joint's action moves a torso that is `factor` as heavy."""
    task = weightless(make_task(domain, backend, bodies={"torso": factor}))
    action = np.zeros_like(task.action_scale)
    action[0] = 0.3
    moved = roll(domain, task, action, backend)[0]
    still = roll(domain, task, 0, backend)[0]
    end = 2 if domain == "halfcheetah" else 3
    return np.linalg.norm((moved - still)[0, 1, :end])


@pytest.mark.slow
def test_moon_slows_a_fall():
    check_free_fall("halfcheetah", "spring", 1)
    check_free_fall("ant", "positional", 2)


@pytest.mark.slow
def test_a_heavy_torso_is_slower_to_move():
    assert 0.2 < push("halfcheetah", None, 4.0) / push("halfcheetah", None, 1.0) < 0.6
    # Nine equal masses, then the torso's four times that: with the momentum kept,
    # the torso's share of the movement falls from 8/9 to 8/12 of the rest's.
    ratio = push("ant", None, 4.0) / push("ant", None, 1.0)
    np.testing.assert_allclose(ratio, 9 / 12, rtol=0.03)


@pytest.mark.parametrize(
    ("domain", "factor", "slope"),
    [
        pytest.param("halfcheetah", 0.4, 0.3, marks=pytest.mark.slow),
        pytest.param("ant", 0.375, 0.7, marks=pytest.mark.slow),
    ],
)
def test_less_friction_slides_further_down_a_slope(domain, factor, slope):
    def slide(friction):
        task = make_task(domain, friction=friction)
        task = edit(task, gravity=task.physics.gravity.at[0].set(9.81 * slope))
        return roll(domain, task, 0)[0][0, -1, 0]

    assert slide(factor) > slide(1.0) + 0.1


def test_masked_joints_do_not_respond_and_the_others_do():
    task = domains.make_domain("ant").make_task(ANT["disabled_forefeet"])
    m = make_task("ant").physics.mj_model
    names = [m.joint(j).name for j in m.actuator_trnid[:, 0]]
    # One lane for every action, pushed for one step alone.
    actions = np.zeros((LANES, STEPS, 8))
    actions[range(8), 0, range(8)] = 0.5
    q = roll("ant", weightless(task), actions)[0]
    still = roll("ant", weightless(task), 0)[0]
    for lane, name in enumerate(names):
        change = np.abs(q - still)[lane, 0, 7:]
        if name in ("hip_1", "ankle_1", "hip_2", "ankle_2"):
            assert change.max() == 0, name
        else:
            assert change.argmax() == JOINTS.index(name)
            assert change.max() > 0.01, name


@pytest.mark.parametrize("domain", ["halfcheetah", "ant"])
def test_inverted_actions_mirror_the_normal_task(domain):
    size = domains.make_domain(domain).environment.action_size
    actions = jax.random.uniform(KEY, (LANES, STEPS, size), minval=-1.0)
    inverted = make_task(domain, actions={"*": -1.0})
    for a, b in zip(
        roll(domain, inverted, actions),
        roll(domain, make_task(domain), -actions),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


def test_masked_actions_cost_nothing_and_hidden_entries_are_zero():
    off = make_task("halfcheetah", actions={"*": 0.0}, hidden=0.5)
    _, observed, reward, terminal, *_ = roll("halfcheetah", off, 1)
    _, full, free, *_ = roll("halfcheetah", make_task("halfcheetah"), 0)
    np.testing.assert_allclose(reward, free, rtol=1e-5)
    np.testing.assert_allclose(observed, full * off.observation_mask, rtol=1e-5)
    assert np.any(full != observed)
    assert terminal.dtype == bool
    assert not terminal.any()


def test_a_fallen_ant_is_terminal():
    high = floating(make_task("ant"), 3.0)
    assert roll("ant", high, 0)[3][:, 0].all()
    assert not roll("ant", make_task("ant"), 0)[3][:, 0].any()


def test_unchanged_task_is_brax_own():
    env = brax.envs.get_environment("halfcheetah", backend="spring")
    action = jnp.linspace(-1, 1, 6)

    def own(key):
        def step(state, _):
            state = env.step(state, action)
            return state, (state.obs, state.reward)

        return jax.lax.scan(step, env.reset(key), None, 5)[1]

    want = jax.jit(own, compiler_options=QUICK)(KEY)
    got = roll("halfcheetah", make_task("halfcheetah"), action)[1:3]
    for x, y in zip(got, want, strict=True):
        np.testing.assert_allclose(x[0, :5], y, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["positional", "generalized", "mjx"])
def test_other_backends_feel_the_changes(backend):
    check_free_fall("halfcheetah", backend, 1)
    heavy, light = (push("halfcheetah", backend, factor) for factor in (4.0, 1.0))
    assert 0.2 * light < heavy < 0.7 * light


def test_roll_outs_of_all_tasks_are_traced_once():
    for name in ("normal", "moon", "hugefoot", "disabled_hard1"):
        roll("ant", domains.make_domain("ant").make_task(ANT[name]), 1)
    assert TRACES.count(("ant", "positional")) == 1
