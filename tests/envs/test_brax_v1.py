import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.envs import brax_v1, brax_v1_shim
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.scenarios import SCENARIOS, make_scenario

LANES, STEPS = 4, 60
KEY = jax.random.key(5)
FIRST, SLOW = ("halfcheetah", "hugefoot"), pytest.mark.slow
# These programs run for milliseconds: spend no time on making them fast.
QUICK = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
DOMAINS = {
    "halfcheetah": ("half_cheetah", "Halfcheetah", 18, 6),
    "ant": ("ant", "Ant", 27, 8),
    "humanoid": ("humanoid", "Humanoid", 240, 17),
}
# By domain: tasks, and what the authors' code changes in the config for each: factors
# on gravity, friction, and the bodies in whose names a word is; which collider.
AUTHORS = {
    "halfcheetah": {
        "normal": {},
        "moon": {"gravity": 0.15},
        "rainfall": {"friction": 0.4},
        "carry_stuff": {"torso": 4.0},
        "hugefoot": {"foot": 1.5},
        "hugefoot_rainfall": {"foot": 1.5, "friction": 0.4},
    },
    "ant": {
        "normal": {},
        "moon": {"gravity": 0.7},
        "rainfall": {"friction": 0.375},
        "hugefoot": {"Body": 1.5},
    },
    "humanoid": {
        "normal": {},
        "moon": {"gravity": 0.15},
        "carrystuff": {"torso": 4.0, "lwaist": 4.0},
        "tinyfeet": {"shin": 0.5},
    },
}
CHANGES = {
    domain: {
        change.name: change
        for spec in SCENARIOS.values()
        if spec.domain == domain
        for change in spec.changes
    }
    for domain in DOMAINS
}


def authors_env(domain: str, task: str):
    """brax.v1's environment on a config that was changed before it is read."""
    from google.protobuf import text_format

    file, cls, _, _ = DOMAINS[domain]
    module = brax_v1_shim.module(f"envs.{file}")
    env = getattr(module, cls)()
    config = text_format.Parse(
        module._SYSTEM_CONFIG, brax_v1_shim.module("physics.config_pb2").Config()
    )
    for word, factor in AUTHORS[domain][task].items():
        if word == "gravity":
            config.gravity.z *= factor
        elif word == "friction":
            config.friction *= factor
        else:
            for body in config.bodies:
                if word in body.name:
                    body.mass *= factor
                    place = -1 if domain == "humanoid" else 0
                    body.colliders[place].capsule.radius *= factor
    env.sys = brax_v1_shim.module("physics.system").System(config)
    return env


def parts(thing, path=""):
    """All numbers in an object of brax.v1, by where they stand."""
    if isinstance(thing, int | float | np.ndarray | jax.Array):
        yield path, np.asarray(thing, np.float32)
    elif isinstance(thing, list | tuple):
        for number, part in enumerate(thing):
            yield from parts(part, f"{path}[{number}]")
    elif type(thing).__module__.startswith("brax.v1.physics"):
        for name, part in sorted(vars(thing).items()):
            yield from parts(part, f"{path}.{name}")


@pytest.mark.parametrize("domain", DOMAINS)
def test_a_tasks_system_is_the_authors(domain):
    systems, seen = brax_v1.Systems(domain), set()
    for name in AUTHORS[domain]:
        want = dict(parts(authors_env(domain, name).sys))
        change = CHANGES[domain].get(name, TaskChange(name))
        got = dict(parts(systems.system(systems.physics(change))))
        assert want.keys() == got.keys()
        assert len(want) > 80
        for path, numbers in want.items():
            np.testing.assert_allclose(got[path], numbers, rtol=1e-6, err_msg=path)
        seen.add(tuple(x.tobytes() for x in want.values()))
    assert len(seen) == len(AUTHORS[domain])


def rolled(reset, step, actions):
    """Starts, then the state after each step, `[steps, lanes]`."""

    def roll(keys):
        first = jax.vmap(reset)(keys)

        def go(state, action):
            state = jax.vmap(step)(state, action)
            return state, state

        return first, jax.lax.scan(go, first, actions)[1]

    keys = jax.random.split(KEY, LANES)
    return jax.jit(roll, compiler_options=QUICK)(keys)


# The others differ in their systems, compared above, and take half a minute each.
@pytest.mark.parametrize(
    ("domain", "name"),
    [
        pytest.param(domain, name, marks=() if (domain, name) == FIRST else SLOW)
        for domain, names in AUTHORS.items()
        for name in names
        if name in CHANGES[domain]
    ],
)
def test_moves_as_the_authors_environment(domain, name):
    """By the same actions from the same states."""
    made = brax_v1.make_domain(domain)
    task = made.make_task(CHANGES[domain][name])
    environment = made.environment
    size = STEPS, LANES, environment.action_size
    actions = jax.random.uniform(KEY, size, minval=-1.0)
    env = authors_env(domain, name)
    first, steps = rolled(env.reset, env.step, actions)

    def ours(key, states, actions):
        start = environment.reset(task, key)

        def one(qp, action):
            state = start._replace(inner=qp)
            return environment.step(task, state, action)

        return start, jax.vmap(one)(states, actions)

    # Each step from where theirs was: rounding grows with every contact.
    before = jax.tree.map(
        lambda a, b: jnp.concatenate([a[None], b[:-1]]), first.qp, steps.qp
    )
    play = jax.jit(jax.vmap(ours, (0, 1, 1), (0, 1)), compiler_options=QUICK)
    start, after = play(jax.random.split(KEY, LANES), before, actions)
    np.testing.assert_allclose(start.inner.pos, first.qp.pos, atol=1e-5)
    np.testing.assert_allclose(start.observation, first.obs, rtol=1e-4, atol=1e-4)
    size = np.maximum(np.abs(steps.obs).max(axis=(0, 1)), 1)
    error = np.abs(after.observation - steps.obs) / size
    # A foot that just touches the ground may do so in one of the two alone.
    assert np.quantile(error, 0.999) < 1e-3
    assert np.median(error) < 1e-5
    off = np.abs(after.reward - steps.reward)
    assert np.quantile(off, 0.98) < 5e-3
    np.testing.assert_array_equal(after.terminal, np.asarray(steps.done) == 1)
    assert np.abs(steps.qp.pos[-1] - first.qp.pos).max() > 0.05


@pytest.mark.parametrize("domain", DOMAINS)
def test_sizes(domain):
    _, _, observations, actions = DOMAINS[domain]
    made = brax_v1.make_domain(domain)
    task = made.make_task(TaskChange("normal"))
    assert made.environment.observation_size == observations
    assert made.environment.action_size == actions
    assert made.environment.episode_length == 1000
    assert task.action_scale.shape == (actions,)
    assert task.observation_mask.shape == (observations,)


@pytest.mark.parametrize("domain", DOMAINS)
def test_one_trace_serves_all_tasks(domain):
    made = brax_v1.make_domain(domain)
    assert brax_v1.make_domain(domain) is made
    tasks = [made.make_task(change) for change in CHANGES[domain].values()]
    count = 0

    @jax.jit
    def act(task, key):
        nonlocal count
        count += 1
        first = made.environment.reset(task, key)
        second = made.environment.step(task, first, task.action_scale)
        return first, second

    first, second = act.trace(tasks[0], KEY).out_info
    for task in tasks[1:]:
        act.trace(task, KEY)
    assert count == 1
    # A state can be carried and replaced: nothing changes its type.
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *tasks)
    assert stacked.physics.radius.shape[0] == len(tasks)


def test_half_of_the_observation_is_hidden_as_in_the_authors_code():
    mask = CHANGES["halfcheetah"]["defective_module"]
    got = brax_v1.make_domain("halfcheetah").make_task(mask).observation_mask
    want = np.random.RandomState(0).permutation([0] * 9 + [1] * 9)
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize(
    ("name", "indices"),
    [
        ("disabled_hard1", [2, 3, 4, 5, 6, 7]),
        ("disabled_hard2", [0, 1, 4, 5, 6, 7]),
        ("disabled_forefeet", [0, 1, 2, 3]),
        ("disabled_backfeet", [4, 5, 6, 7]),
        ("disabled_first_diagonal", [0, 1, 4, 5]),
        ("disabled_second_diagonal", [2, 3, 6, 7]),
    ],
)
def test_disabled_legs_have_the_authors_indices(name, indices):
    scale = brax_v1.make_domain("ant").make_task(CHANGES["ant"][name]).action_scale
    assert np.flatnonzero(np.asarray(scale) == 0).tolist() == indices
    assert set(np.asarray(scale)) == {0.0, 1.0}


def test_a_joint_of_several_axes_has_several_actions():
    change = TaskChange("limp", actions={"right_hip_xyz": 0.0, "*": -1.0})
    scale = brax_v1.make_domain("humanoid").make_task(change).action_scale
    assert np.flatnonzero(np.asarray(scale) == 0).tolist() == [3, 4, 5]


@pytest.mark.parametrize(
    ("domain", "change", "message"),
    [
        ("ant", {"bodies": {"tail": 2.0}}, "lower_leg_1"),
        ("humanoid", {"bodies": {"left_foot": 2.0}}, "left_shin"),
        ("ant", {"bodies": {"ground": 2.0}}, "torso"),
        ("humanoid", {"actions": {"abdomen_z": 0.0}}, "abdomen_yz"),
        ("ant", {"bodies": {"torso": 0.0}}, "> 0"),
        ("halfcheetah", {"friction": -1.0}, "friction"),
        ("halfcheetah", {"extra": {"goal": 1}}, "goal"),
    ],
)
def test_mistakes_are_told(domain, change, message):
    with pytest.raises(UserError, match=message):
        brax_v1.make_domain(domain).make_task(TaskChange("changed", **change))


def test_a_newer_brax_is_told_what_to_install():
    code = """
import sys
sys.modules["brax.v1"] = None  # what an import of a missing module finds
from rewire_jax import make_scenario
from rewire_jax.core.errors import UserError
make_scenario("ant/transfer", "spring")
try:
    make_scenario("ant/transfer")
except UserError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    (line,) = done.stdout.splitlines()
    assert "brax==0.12.3" in line
    assert "--backend" in line


def test_gyms_notice_does_not_reach_the_user():
    code = "from rewire_jax import make_scenario; make_scenario('humanoid/hard')"
    done = subprocess.run(
        [sys.executable, "-W", "default", "-c", code],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "ym" not in done.stdout + done.stderr


def test_what_is_seen_has_the_tasks_sizes():
    scenario = make_scenario("halfcheetah/forgetting")
    hugefoot, moon = (task.data for task in scenario.tasks[:2])
    film = scenario.environment.film
    start = jax.jit(scenario.environment.reset)(hugefoot, KEY).inner
    large, normal = (film(task, [start, start]) for task in (hugefoot, moon))
    ratio = large.model.geom_size[:-1, 0] / normal.model.geom_size[:-1, 0]
    # Torso and head, two thighs, shins and feet.
    np.testing.assert_allclose(ratio, [1, 1, 1, 1, 1.5, 1, 1, 1.5], rtol=1e-5)
    assert large.position.shape == (2, 9, 3)
    np.testing.assert_allclose(
        large.rotation[0] @ large.rotation[0].transpose(0, 2, 1),
        np.broadcast_to(np.eye(3), (9, 3, 3)),
        atol=1e-6,
    )
    # A reset puts the lowest point of all capsules on the ground.
    ends = large.rotation[0, :8, 2, 2] * large.model.geom_size[:8, 1]
    lowest = large.position[0, :8, 2] - np.abs(ends) - large.model.geom_size[:8, 0]
    assert lowest.min() == pytest.approx(0, abs=1e-4)
