import brax.contact
import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.envs import brax as domains
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.scenarios import SCENARIOS

KEY = jax.random.key(3)
CHANGES = {
    domain: {
        change.name: change
        for spec in SCENARIOS.values()
        if spec.domain == domain
        for change in spec.changes
    }
    for domain in domains.NAMES
}


def make_task(domain, backend="positional", /, **change):
    make = domains.make_domain(domain, backend).make_task
    return make(TaskChange("changed", **change))


def model(domain):
    task = make_task(domain)
    return task.physics.mj_model


def geoms(domain, body_joint):
    """Geoms of the body that hangs on a joint."""
    m = model(domain)
    return np.flatnonzero(m.geom_bodyid == m.joint(body_joint).bodyid[0])


def ratio(changed, normal, leaf):
    def get(task):
        for name in leaf.split("."):
            task = getattr(task, name)
        return np.asarray(task)

    a, b = get(changed.physics), get(normal.physics)
    return np.divide(a, b, out=np.ones_like(a), where=b != 0)


# Names and shapes ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("domain", "observations", "actions"),
    [("halfcheetah", 17, 6), ("ant", 27, 8), ("humanoid", 244, 17)],
)
def test_sizes(domain, observations, actions):
    environment = domains.make_domain(domain).environment
    task = make_task(domain)
    assert environment.observation_size == observations
    assert environment.action_size == actions
    assert environment.episode_length == 1000
    assert task.action_scale.shape == (actions,)
    assert task.observation_mask.shape == (observations,)


def test_same_arguments_give_the_identical_domain():
    one = domains.make_domain("ant", "spring")
    assert domains.make_domain(name="ant", backend="spring") is one
    assert domains.make_domain("ant", "positional") is not one


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: domains.make_domain("walker"), "halfcheetah, ant, humanoid"),
        (lambda: domains.make_domain("ant", "fast"), "positional, spring"),
        (lambda: make_task("ant", bodies={"tail": 2.0}), "lower_leg_1"),
        (lambda: make_task("ant", actions={"knee": 0.0}), "hip_4, ankle_4"),
        (lambda: make_task("ant", bodies={"torso": 0.0}), "> 0"),
        (lambda: make_task("ant", friction=-1.0), "friction"),
        (lambda: make_task("ant", hidden=1.5), "hidden"),
        (lambda: make_task("ant", extra={"goal": 1}), "goal"),
    ],
)
def test_mistakes_are_told(call, message):
    with pytest.raises(UserError, match=message):
        call()


# Tasks as data ------------------------------------------------------------------


@pytest.mark.parametrize("domain", domains.NAMES)
@pytest.mark.parametrize(
    "backend",
    [
        "positional",
        pytest.param("spring", marks=pytest.mark.slow),
        pytest.param("generalized", marks=pytest.mark.slow),
        pytest.param("mjx", marks=pytest.mark.slow),
    ],
)
def test_one_trace_serves_all_tasks(domain, backend):
    made = domains.make_domain(domain, backend)
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
    assert stacked.physics.geom_size.shape[0] == len(tasks)
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(tasks))


@pytest.mark.parametrize("domain", domains.NAMES)
def test_only_what_a_task_changes_differs(domain):
    normal = make_task(domain)
    base = model(domain)
    for name, change in CHANGES[domain].items():
        task = domains.make_domain(domain).make_task(change)
        allowed = set()
        if change.gravity != 1:
            allowed |= {".gravity", ".opt.gravity"}
        if change.friction != 1:
            allowed |= {".geom_friction"}
        if change.bodies:
            allowed |= {".geom_size", ".geom_rbound", ".stat.meaninertia"}
            allowed |= {".body_mass", ".body_subtreemass", ".link.inertia.mass"}
            allowed |= {".body_invweight0", ".dof_invweight0"}
            allowed |= {".link.invweight", ".dof.invweight"}
        leaves = jax.tree_util.tree_leaves_with_path(task.physics)
        differing = {
            jax.tree_util.keystr(path)
            for (path, a), b in zip(
                leaves, jax.tree.leaves(normal.physics), strict=True
            )
            if not np.array_equal(a, b, equal_nan=True)
        }
        assert differing == allowed, name
    np.testing.assert_array_equal(base.body_mass[1:], model(domain).body_mass[1:])
    assert task.physics.mj_model is base


def test_gravity():
    moon, normal = make_task("halfcheetah", gravity=0.15), make_task("halfcheetah")
    for leaf in ("gravity", "opt.gravity"):
        np.testing.assert_allclose(ratio(moon, normal, leaf), [1, 1, 0.15], rtol=1e-6)


def test_friction_of_every_contact():
    rain, normal = make_task("ant", friction=0.375), make_task("ant")
    np.testing.assert_allclose(ratio(rain, normal, "geom_friction"), 0.375, rtol=1e-6)
    contacts = [contact(task).friction for task in (rain, normal)]
    np.testing.assert_allclose(contacts[0], 0.375 * contacts[1], rtol=1e-5)


def contact(task):
    """Brax's contacts of all bodies at the origin, however far."""
    x = brax.base.Transform.zero((task.physics.num_links(),))
    return jax.jit(brax.contact.get)(task.physics, x)


@pytest.mark.parametrize(
    ("domain", "bodies", "joint", "resized"),
    [
        ("halfcheetah", {"torso": 4.0}, "rooty", [0]),  # not the head
        ("halfcheetah", {"ffoot": 0.5}, "ffoot", [0]),
        ("ant", {"lower_leg_2": 1.5}, "ankle_2", [0, 1]),  # capsule and foot
        ("humanoid", {"left_shin": 0.5}, "left_knee", [1]),  # the foot
        ("humanoid", {"torso": 4.0}, "root", [2]),
    ],
)
@pytest.mark.parametrize("backend", ["positional", "mjx"])
def test_body_factor(domain, bodies, joint, resized, backend):
    changed, normal = (
        make_task(domain, backend, bodies=bodies),
        make_task(domain, backend),
    )
    (factor,) = bodies.values()
    body = model(domain).joint(joint).bodyid[0]
    mass = np.ones(model(domain).nbody)
    mass[body] = factor
    radius = np.ones(model(domain).ngeom)
    radius[geoms(domain, joint)[resized]] = factor
    close = {"rtol": 1e-5}
    np.testing.assert_allclose(ratio(changed, normal, "body_mass"), mass, **close)
    acting = ratio(changed, normal, "link.inertia.mass")
    np.testing.assert_allclose(acting, mass[1:], **close)
    size = ratio(changed, normal, "geom_size")
    np.testing.assert_allclose(size[:, 0], radius, **close)
    np.testing.assert_array_equal(size[:, 1:], 1)
    bound = changed.physics.geom_rbound - normal.physics.geom_rbound
    growth = normal.physics.geom_size[:, 0] * (radius - 1)
    np.testing.assert_allclose(bound, growth, atol=1e-6)
    # A heavier body gives way less.
    give = ratio(changed, normal, "body_invweight0")[body, 0]
    assert give < 1 if factor > 1 else give > 1
    assert (
        ratio(changed, normal, "link.inertia.i").tolist()
        == np.ones_like(normal.physics.link.inertia.i).tolist()
    )


def test_radius_reaches_the_ground_sooner():
    huge = make_task("ant", bodies={f"lower_leg_{i}": 1.5 for i in (1, 2, 3, 4)})
    nearer = contact(make_task("ant")).dist - contact(huge).dist
    np.testing.assert_allclose(nearer, 0.08 * 0.5, rtol=1e-4)


def test_masses_that_act_are_brax_own_where_nothing_changes():
    for domain in domains.NAMES:
        for backend in ("positional", "spring"):
            own = brax.envs.get_environment(domain, backend=backend).sys
            ours = make_task(domain, backend).physics
            want = own.link.inertia.mass ** (1 - own.spring_mass_scale)
            got = ours.link.inertia.mass ** (1 - ours.spring_mass_scale)
            np.testing.assert_allclose(got, want, rtol=1e-6)


def test_hidden_half_is_fixed_and_a_half():
    mask = np.asarray(make_task("halfcheetah", hidden=0.5).observation_mask)
    want = np.random.RandomState(0).permutation([0.0] * 8 + [1.0] * 9)
    np.testing.assert_array_equal(mask, want)
    assert np.all(np.asarray(make_task("halfcheetah").observation_mask) == 1)


V1_JOINTS = [f"{joint}_{leg}" for leg in (1, 2, 3, 4) for joint in ("hip", "ankle")]


@pytest.mark.parametrize(
    ("name", "v1_indices"),
    [
        ("disabled_hard1", [2, 3, 4, 5, 6, 7]),
        ("disabled_hard2", [0, 1, 4, 5, 6, 7]),
        ("disabled_forefeet", [0, 1, 2, 3]),
        ("disabled_backfeet", [4, 5, 6, 7]),
        ("disabled_first_diagonal", [0, 1, 4, 5]),
        ("disabled_second_diagonal", [2, 3, 6, 7]),
    ],
)
def test_ant_masks_mean_what_they_meant_in_v1(name, v1_indices):
    order = [
        "hip_4",
        "ankle_4",
        "hip_1",
        "ankle_1",
        "hip_2",
        "ankle_2",
        "hip_3",
        "ankle_3",
    ]
    off = {V1_JOINTS[i] for i in v1_indices}
    scale = domains.make_domain("ant").make_task(CHANGES["ant"][name]).action_scale
    assert scale.tolist() == [0.0 if joint in off else 1.0 for joint in order]


def test_action_factors_multiply():
    scale = make_task("ant", actions={"*": -1.0, "hip_4": 0.5}).action_scale
    assert scale.tolist() == [-0.5] + [-1.0] * 7


def test_legs_stand_where_their_numbers_say():
    m = model("ant")
    for leg, quadrant in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)], start=1):
        pos = m.body_pos[m.joint(f"hip_{leg}").bodyid[0], :2]
        assert tuple(np.sign(pos)) == quadrant
