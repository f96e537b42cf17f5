import itertools
import operator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.methods import pnn
from rewire_jax.methods.pnn import PnnSettings
from rewire_jax.methods.shared import map_own
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.training import rollout
from rewire_jax.training.memory_estimate import size
from rewire_jax.training.run_setup import prepare
from tests.tiny import tiny

WIDTH, TASKS = 4, 4
SPEC = Spec(observations=3, actions=2, hidden=7, depth=2, tasks=TASKS)
OPTIONS = PnnSettings(width=WIDTH)
KEY = jax.random.key(0)
OBSERVATION = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
PLAIN = pnn.pnn(SPEC, OPTIONS)
METHOD = PLAIN._replace(
    **{
        name: jax.jit(getattr(PLAIN, name))
        for name in ("init", "start_task", "distribution", "end_task", "policy", "act")
    }
)


def arrays(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def same(one, other):
    for a, b in zip(arrays(one), arrays(other), strict=True):
        np.testing.assert_array_equal(a, b)


def near(one, other):
    for a, b in zip(arrays(one), arrays(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def leaky(x):
    return np.where(x > 0, x, 0.2 * x)


def normalized(x):
    return (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)


def played(columns, observation=OBSERVATION, between=leaky):
    """The last column's policy, from unpadded concatenations in numpy."""
    observation = observation.astype(np.float64)
    before = [[] for _ in range(SPEC.depth)]
    for place, column in enumerate(columns):
        first, *layers = jax.tree.map(np.asarray, column.layers)
        x = observation @ first.weight.T + first.bias
        hidden = []
        for i, (weight, bias) in enumerate(layers):
            x = between(x)
            hidden.append(x)
            x = x @ weight.T + bias
            if place > 0:
                lateral = jax.tree.map(np.asarray, column.laterals[i])
                joined = lateral.scale * np.concatenate(before[i], axis=-1)
                inner = leaky(joined @ lateral.inner[:, : place * WIDTH].T)
                x += inner @ lateral.outer.weight.T + lateral.outer.bias
        for joined, own in zip(before, hidden, strict=True):
            joined.append(own)
    return x[:, :2], np.clip(x[:, 2:], -20, 2)


def loss(params, state, observation=OBSERVATION):
    mean, log_std = PLAIN.distribution(params, state, (), observation)
    return jnp.sum(jnp.sin(mean)) + jnp.sum(log_std**2)


slopes = jax.jit(jax.grad(loss, argnums=(0, 1, 2), allow_int=True))


def after_tasks(number):
    """Columns trained by a few gradient steps, and what each task began with."""
    params, state = METHOD.init(KEY)
    columns, starts = [], []
    for task in range(number):
        key = jax.random.fold_in(KEY, task)
        params, state = METHOD.start_task(key, params, state, task)
        starts.append((params, state))
        for _ in range(3):
            slope, *_ = slopes(params, state, OBSERVATION)
            params = jax.tree.map(lambda x, g: x - 0.01 * g, params, slope)
        columns.append(params)
        params, state = METHOD.end_task(params, state, task, None)
    return params, state, columns, starts


@pytest.fixture(scope="module")
def learned():
    return after_tasks(TASKS)


@pytest.mark.parametrize("task", range(TASKS))
def test_a_column_plays_as_with_unpadded_concatenations(learned, task):
    params, state, columns, starts = learned
    expected = played(columns[: task + 1])
    near(METHOD.act(METHOD.policy(params, state, task), OBSERVATION), expected)
    policy = METHOD.policy(params, state, task)
    expected = played(columns[: task + 1], between=lambda x: leaky(normalized(x)))
    near(jax.jit(pnn.act_of("layer_norm"))(policy, OBSERVATION), expected)
    # In training, too.
    column, then = starts[task]
    expected = played([*columns[:task], column])
    near(METHOD.distribution(column, then, (), OBSERVATION), expected)


def test_the_earlier_columns_matter(learned):
    _, _, columns, _ = learned
    for place in range(2):
        others = list(columns[:3])
        others[place] = columns[3]
        assert not np.allclose(played(others)[0], played(columns[:3])[0])


def test_only_the_new_column_learns(learned):
    _, _, _, starts = learned
    for task, (params, state) in enumerate(starts):
        own, frozen, observation = slopes(params, state, OBSERVATION)
        assert all(not leaf.any() for leaf in arrays(frozen.columns))
        assert not np.any(observation)
        for layer in own.layers:
            assert np.all(np.any(layer.weight, axis=1))
        for lateral in own.laterals:
            used = task * WIDTH
            # The places of columns that do not come before are without gradient.
            assert not np.any(lateral.inner[:, used:])
            assert np.all(np.any(lateral.inner[:, :used], axis=0))
            if task == 0:
                assert not any(leaf.any() for leaf in arrays(lateral))
            else:
                assert lateral.scale != 0
                assert np.all(lateral.outer.bias != 0)


def test_the_gradient_is_that_of_finite_differences(learned):
    params, state = learned[3][2]
    slope, *_ = slopes(params, state, OBSERVATION)
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda x: rng.normal(size=x.shape), params)

    def value(step):
        moved = jax.tree.map(
            lambda x, d: np.asarray(x, float) + step * d, params, direction
        )
        mean, log_std = played([*learned[2][:2], moved])
        return np.sum(np.sin(mean)) + np.sum(log_std**2)

    expected = (value(1e-5) - value(-1e-5)) / 2e-5
    actual = sum(
        np.sum(g * d) for g, d in zip(arrays(slope), arrays(direction), strict=True)
    )
    assert actual == pytest.approx(expected, rel=1e-3)


def test_a_learned_task_never_changes():
    outputs = []
    for number in range(1, TASKS + 1):
        params, state, *_ = after_tasks(number)
        states = [(params, state)]
        if number < TASKS:
            states.append(METHOD.start_task(KEY, params, state, number))
        for state in states:
            now = [
                METHOD.act(METHOD.policy(*state, task), OBSERVATION)
                for task in range(TASKS)
            ]
            for task, output in enumerate(outputs):
                same(output, now[task])
            # A task not yet seen gets the latest column.
            for task in range(number, TASKS):
                same(now[task], now[number - 1])
        outputs.append(now[number - 1])
    assert len({float(output[0][0, 0]) for output in outputs}) == TASKS


def test_before_training_all_tasks_have_the_first_column():
    params, state = METHOD.init(KEY)
    for task in range(TASKS):
        output = METHOD.act(METHOD.policy(params, state, task), OBSERVATION)
        near(output, played([params]))


def test_a_sequence_of_one_task_is_a_plain_policy():
    method = pnn.pnn(SPEC._replace(tasks=1), OPTIONS)
    params, state = method.init(KEY)
    params, state = method.start_task(KEY, params, state, 0)
    expected = networks.mlp_policy(params.layers, OBSERVATION)
    near(method.distribution(params, state, (), OBSERVATION), expected)
    params, state = method.end_task(params, state, 0, None)
    near(method.act(method.policy(params, state, 0), OBSERVATION), expected)
    assert method.size(params, state) == 3 * 4 + 4 + 4 * 4 + 4 + 4 * 4 + 4


def test_columns_start_uniform_within_their_fan_in():
    spec = SPEC._replace(observations=16, depth=3, tasks=5)
    width = 25
    start = jax.jit(pnn.pnn(spec, PnnSettings(width=width)).start_task)
    scales = {}
    for task in (1, 4):
        column, _ = start(jax.random.key(task), (), (), task)
        assert [len(layer.bias) for layer in column.layers] == [25, 25, 25, 4]
        for lateral in column.laterals:
            bound = (width * task) ** -0.5
            assert 0.98 * bound < np.max(np.abs(lateral.inner)) <= bound
            assert np.mean(lateral.inner) == pytest.approx(0, abs=0.1 * bound)
            assert np.std(lateral.inner) == pytest.approx(bound / 3**0.5, rel=0.05)
            assert 0.9 * 0.2 < np.max(np.abs(lateral.outer.weight)) <= 0.2
        columns, _ = jax.vmap(start, (0, None, None, None))(
            jax.random.split(KEY, 100), (), (), task
        )
        scales[task] = np.stack([lateral.scale for lateral in columns.laterals])
        assert scales[task].min() >= 0
        assert 0.98 / task < scales[task].max() < 1 / task
    assert len(np.unique(scales[1])) > 290


@pytest.mark.parametrize(
    ("observations", "actions", "base", "published"),
    [(18, 6, 139_532, 7.8), (27, 8, 142_864, 7.7)],
)
def test_eight_columns_have_the_published_size(observations, actions, base, published):
    spec = Spec(observations, actions, hidden=256, depth=3, tasks=8)
    options = pnn.preset("halfcheetah/forgetting", 4, "paper")
    method = pnn.pnn(spec, options)
    params, state = jax.eval_shape(method.init, KEY)
    for learned in range(9):
        numbers = 0
        for place in range(max(learned, 1)):
            n = options.width
            for inputs, outputs in (
                (observations, n),
                (n, n),
                (n, n),
                (n, 2 * actions),
            ):
                numbers += inputs * outputs + outputs
                if place > 0 and inputs == n:
                    numbers += 1 + place * n * n + n * outputs + outputs
        assert method.size(params, state._replace(learned=learned)) == numbers
    assert round(numbers / base, 1) == published


@pytest.mark.slow
def test_members_are_the_same_alone():
    def member(key):
        first, state = PLAIN.init(key)
        params, state = PLAIN.end_task(first, state, 0, None)
        params, state = PLAIN.start_task(key, params, state, 1)
        slope = jax.grad(loss)(params, state)
        params = jax.tree.map(lambda x, g: x - 0.01 * g, params, slope)
        params, state = PLAIN.end_task(params, state, 1, None)
        tasks = jnp.arange(TASKS)
        policies = jax.vmap(PLAIN.policy, (None, None, 0))(params, state, tasks)
        return jax.vmap(PLAIN.act, (0, None))(policies, OBSERVATION)

    keys = jax.random.split(KEY, 2)
    crowd, alone = jax.jit(jax.vmap(member))(keys), jax.jit(member)
    for number in range(2):
        near(jax.tree.map(operator.itemgetter(number), crowd), alone(keys[number]))
    assert not np.allclose(crowd[0][0], crowd[0][1])


def test_presets_and_settings():
    assert pnn.preset("ant/forgetting", 4, "paper").width == 96
    assert pnn.preset("ant/forgetting", 4, "quick").width == 48
    with pytest.raises(UserError, match="--width"):
        PnnSettings(width=0).checked()


def test_policies_of_all_tasks_hold_the_columns_once():
    def bytes_of(tasks):
        plan = prepare(replace(tiny(method="pnn"), seeds=3, tasks=tasks))
        learner = jax.eval_shape(plan.program.init, plan.stacked)
        policies = jax.eval_shape(plan.program.policies, plan.stacked, learner)
        return size(policies), size(learner.method_state.columns)

    for tasks in (1, 2, 3):
        policies, columns = bytes_of(tasks)
        assert policies == columns + 3 * tasks * 4  # a place for each


def test_policies_that_share_play_as_each_alone():
    plan = prepare(tiny(method="pnn"))
    program, members, tasks = plan.program, plan.stacked, plan.tasks
    learner = program.init(members)
    for stage in range(plan.spec.tasks):
        params, state = jax.vmap(
            lambda key, params, state, t=stage: pnn_of(plan).start_task(
                key, params, state, t
            )
        )(members.keys, learner.params, learner.method_state)
        learner = learner._replace(params=params, method_state=state)
        learner = program.finish(members, learner, stage, None)
    keys = jax.vmap(lambda key: jax.random.split(key, len(plan.names)))(members.keys)
    together = program.rollout(
        tasks, program.policies(members, learner), keys, 2
    ).returns

    @jax.jit
    def alone(tasks, policies, keys):
        environment = plan.scenario.environment
        act = pnn_of(plan).act
        return rollout.episodes(environment, act, tasks, policies, keys, 2).returns

    for place, row in itertools.product(range(plan.num_slots), range(len(plan.names))):
        mine = jax.tree.map(
            lambda x, p=place: x[p], (learner.params, learner.method_state)
        )
        policy = pnn_of(plan).policy(*mine, jnp.asarray(row))
        stacked = jax.tree.map(lambda x: x[None], policy)
        stacked = map_own(lambda x: x[None], stacked)
        returns = alone(
            jax.tree.map(lambda x, r=row: x[r : r + 1], tasks),
            stacked,
            keys[place : place + 1, row : row + 1],
        )
        np.testing.assert_allclose(returns[0, 0], together[place, row], rtol=1e-4)
    assert len(set(np.asarray(together).ravel().tolist())) > plan.num_slots


def pnn_of(plan):
    return pnn.pnn(plan.spec, plan.settings.options)
