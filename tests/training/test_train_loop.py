import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rewire_jax.methods.base import Selection
from rewire_jax.training import population
from tests.compiles import assert_once, compiles
from tests.loops import equal
from tests.reach_loop import (
    RANDOM,
    SEEDS,
    SHAPE,
    TASKS,
    WARMUP,
    begin,
    build,
    configurations,
    crowd,
    go,
)


def member(tree, number):
    return jax.tree.map(lambda leaf: leaf[number], tree)


def differ(one, other):
    """Whether no leaf is the same."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return not any(np.array_equal(a, b) for a, b in pairs)


@pytest.fixture(scope="module")
def program():
    return build("ft1")


@pytest.fixture(scope="module")
def started(program):
    return begin(program, crowd())


@pytest.fixture(scope="module")
def whole(program, started):
    """25 steps, beyond the episodes' ends and the buffer's."""
    return go(program, crowd(), started, [25])


def test_chunks_do_not_matter(program, started, whole):
    state, (report,) = whole
    parts, reports = go(program, crowd(), started, [5, 1, 4, 10, 5])
    equal(state, parts)
    added = functools.reduce(lambda *pair: jax.tree.map(np.add, *pair), reports)
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-5), report, added
    )
    np.testing.assert_array_equal(report.episodes, [SHAPE.envs] * 4)
    np.testing.assert_array_equal(report.updates, [25 - WARMUP] * 4)
    assert np.isfinite(report.metrics["critic_loss"]).all()
    # A reach of 20 steps costs at most 20 times the square's diagonal, squared.
    returns = report.returns / report.episodes
    assert ((returns < 0) & (returns > -20 * 4.5)).all()


def test_the_given_state_is_used_up(program, started):
    state = jax.tree.map(jnp.copy, started)
    program.chunk(crowd(), state, 0, TASKS[0], 0, 1)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(state.collection.buffer))


def same_alone(method, program, state, reports, steps):
    together = [
        member(program.policies(crowd(method), state.learner), i) for i in range(4)
    ]
    for number in range(4):
        configuration, seed = divmod(number, len(SEEDS))
        alone = population.stack(
            population.cross([configurations(method)[configuration]], [SEEDS[seed]])
        )
        lonely, lonely_reports = go(program, alone, begin(program, alone), steps)
        near = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4)
        jax.tree.map(near, member(state.learner, number), member(lonely.learner, 0))
        jax.tree.map(near, member(reports[-1], number), member(lonely_reports[-1], 0))
        policy = member(program.policies(alone, lonely.learner), 0)
        jax.tree.map(near, together[number], policy)
        assert lonely.active.all()


def test_members_are_the_same_alone(program, whole):
    same_alone("ft1", program, *whole, [25])
    state, (report,) = whole
    # They differ, each from each.
    for one in range(4):
        for other in range(one):
            learners = [member(state.learner.params, i) for i in (one, other)]
            assert differ(*learners)
            assert report.returns[one] != report.returns[other]


@pytest.mark.slow
def test_members_with_modes_of_their_own_are_the_same_alone():
    program, members = build("rewire"), crowd("rewire")
    state, reports = go(program, members, begin(program, members), [25])
    same_alone("rewire", program, state, reports, [25])


def test_nothing_is_learned_before_the_warm_up(program, started):
    state, (report,) = go(program, crowd(), started, [WARMUP])
    equal(state.learner, started.learner)
    assert not report.updates.any()
    assert not any(total.any() for total in report.metrics.values())
    after, (report,) = go(program, crowd(), state, [1], time=WARMUP)
    assert differ(after.learner.params, started.learner.params)
    assert differ(after.learner.critic, started.learner.critic)
    np.testing.assert_array_equal(report.updates, np.ones(4))
    # One round: 3 updates of the critics; the first and third move the rest.
    policy, critics, temperature = after.learner.optimizers
    counts = [state.count for state in (policy, critics, temperature)]
    np.testing.assert_array_equal(counts, [[2] * 4, [3] * 4, [2] * 4])


def test_the_delays_run_on_from_step_to_step(program, whole):
    policy, critics, _ = whole[0].learner.optimizers
    updates = (25 - WARMUP) * SHAPE.updates
    np.testing.assert_array_equal(critics.count, [updates] * 4)
    np.testing.assert_array_equal(policy.count, [updates / 2] * 4)


@pytest.mark.parametrize("place", ["critic", "optimizer", "buffer"])
def test_a_member_that_is_not_finite_is_frozen(program, started, whole, place):
    members = crowd()
    halfway, _ = go(program, members, started, [10])
    learner, collection, *_ = halfway

    def poison(leaf, value=jnp.nan):
        return leaf.at[1].set(value)

    if place == "critic":
        critic = jax.tree.map(poison, learner.critic)
        planted = halfway._replace(learner=learner._replace(critic=critic))
    elif place == "optimizer":
        policy, *others = learner.optimizers
        policy = policy._replace(mu=jax.tree.map(poison, policy.mu))
        optimizers = (policy, *others)
        planted = halfway._replace(learner=learner._replace(optimizers=optimizers))
    else:
        reward = poison(collection.buffer.reward, jnp.inf)
        buffer = collection.buffer._replace(reward=reward)
        planted = halfway._replace(collection=collection._replace(buffer=buffer))
    state, _ = go(program, members, planted, [15], time=10)
    np.testing.assert_array_equal(state.active, [True, False, True, True])
    # What it had last stays, with the optimisers.
    equal(member(state.learner, 1), member(planted.learner, 1))
    for number in (0, 2, 3):
        equal(member(state, number), member(whole[0], number))
    # It stays frozen in the next task.
    active = np.array(state.active)
    state = program.begin(members, state.learner, active, 1, TASKS[1])
    frozen = member(state.learner, 1)
    state, _ = go(program, members, state, [WARMUP + 1], index=1)
    np.testing.assert_array_equal(state.active, active)
    equal(member(state.learner, 1), frozen)


def test_the_first_actions_are_uniform_and_do_not_ask_the_policy(program, started):
    # A policy that always wants to go to one side.
    learner = started.learner
    *hidden, last = learner.params
    last = last._replace(bias=last.bias.at[:, :2].set(9.0).at[:, 2:].set(-9.0))
    pushing = learner._replace(params=(*hidden, last))
    steps = RANDOM + 2
    actions = []
    for state in (started, started._replace(learner=pushing)):
        state, _ = go(program, crowd(), state, [steps])
        actions.append(np.asarray(state.collection.buffer.action)[:, :steps])
    equal(actions[0][:, :RANDOM], actions[1][:, :RANDOM])
    # Configurations share the draws of a seed, seeds share nothing.
    equal(actions[0][:2, :RANDOM], actions[0][2:, :RANDOM])
    uniform = actions[0][:2, :RANDOM].ravel()
    assert len(set(uniform)) == len(uniform)
    assert stats.kstest(uniform, stats.uniform(-1, 2).cdf).pvalue > 1e-4
    assert (actions[1][:, RANDOM:] > 0.99).all()
    assert (actions[0][:, RANDOM:] < 0.99).any()


@pytest.fixture(scope="module")
def pink():
    """The crowd, exploring with pink noise."""
    members = crowd()
    return members._replace(sac=dataclasses.replace(members.sac, noise_color=1.0))


def test_chunks_do_not_matter_to_pink_noise(program, started, whole, pink):
    state, _ = go(program, pink, started, [25])
    parts, _ = go(program, pink, started, [5, 1, 4, 10, 5])
    equal(state, parts)
    white, coloured = (
        np.asarray(s.collection.buffer.action)[:, np.arange(9, 25) % 17]
        for s in (whole[0], state)
    )
    # The first actions are uniform all the same.
    equal(white[:, : RANDOM - 9], coloured[:, : RANDOM - 9])
    assert (white[:, RANDOM - 9 :] != coloured[:, RANDOM - 9 :]).mean() > 0.9


def test_exploring_actions_have_the_noise_of_the_setting(program, started, pink):
    # A policy of standard normals that learns nothing, in episodes of 20 steps.
    *hidden, last = started.learner.params
    params = (*hidden, jax.tree.map(jnp.zeros_like, last))
    learner = started.learner._replace(params=params)
    active = jnp.zeros_like(started.active)
    state = started._replace(learner=learner, active=active)
    seen = []
    for time in range(0, 220, 20):
        state, _ = go(program, pink, state, [20], time=time)
        held = np.arange(time + 4, time + 20) % (SHAPE.transitions + 1)
        seen.append(np.arctanh(np.asarray(state.collection.buffer.action)[:, held]))
    # `[episodes, members, steps, sequences]`, after the episode with uniform actions.
    noise = np.reshape(seen[1:], (10, 4, 16, -1))
    # Configurations share the draws of a seed.
    np.testing.assert_allclose(noise[:, :2], noise[:, 2:], atol=1e-4)
    noise = np.moveaxis(noise[:, :2], 2, 0).reshape(16, 10, -1)
    # Autocovariance is the transform of the power, which is flat below 1/20.
    turns = 2 * np.pi * np.arange(20) / 20
    power = 1 / np.array([1, *range(1, 11), *range(9, 0, -1)])
    for lag in (0, 1, 5):
        products = noise[: 16 - lag] * noise[lag:]
        expected = np.sum(power * np.cos(lag * turns)) / power.sum()
        assert products.mean() == pytest.approx(expected, abs=0.1)
    # Every episode has noise of its own.
    assert np.mean(noise[:, 1:] * noise[:, :-1]) == pytest.approx(0, abs=0.1)


def test_the_buffer_holds_what_the_environments_did(program, whole):
    state, _ = whole
    buffer, episodes, _ = state.collection
    rows = SHAPE.transitions + 1
    last = 25 % rows
    equal(buffer.observation[:, last], episodes.state.observation)
    np.testing.assert_array_equal(episodes.steps, np.full((4, SHAPE.envs), 5))
    # Time 19 was the cut; row 20 holds the start again.
    cut = np.asarray(buffer.truncated)
    np.testing.assert_array_equal(np.argwhere(cut)[:, 1], np.full(cut.sum(), 19 % rows))
    equal(buffer.observation[:, 20 % rows], episodes.start.observation)
    # Rewards are those of the true next observations.
    goal = TASKS[0].physics
    seen, action = np.asarray(buffer.observation), np.asarray(buffer.action)
    moved = np.clip(seen + 0.1 * action, -1, 1)
    reward = -np.sum((moved - np.asarray(goal)) ** 2, axis=-1)
    held = [time % rows for time in range(25 - SHAPE.transitions, 25)]
    np.testing.assert_allclose(buffer.reward[:, held], reward[:, held], atol=1e-5)
    slot = 19 // 20 % buffer.final.shape[1]
    np.testing.assert_allclose(buffer.final[:, slot], moved[:, 19 % rows], atol=1e-6)


def sequence(method, tasks):
    """Trains one task after the other, as a run does."""
    # A number of members that no other test has.
    program, number = build(method), 6
    members = population.stack(population.cross(configurations(method), (1, 2, 3)))
    learner, active = program.init(members), np.ones(number, bool)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *TASKS)
    keys = jax.random.split(jax.random.key(0), (number, len(TASKS)))
    returns = []
    for index in range(tasks):
        state = program.begin(members, learner, active, index, TASKS[index])
        for time, steps in ((0, 6), (6, 3), (9, 1)):
            state, _ = program.chunk(members, state, index, TASKS[index], time, steps)
        learner, active = state.learner, np.array(state.active)
        selection = None
        if program.candidates is not None:
            valid = program.candidates(members, learner, index).valid
            selection = Selection(jnp.zeros(valid.shape), jnp.ones(valid.shape))
        learner = program.finish(members, learner, index, selection)
        policies = program.policies(members, learner)
        returns.append(program.rollout(stacked, policies, keys, 2).returns)
        sizes, stored = program.size(members, learner)
        assert (sizes > 0).all()
        assert (stored == 0).all()
    assert np.isfinite(returns).all()


@pytest.mark.parametrize(
    "method", ["ft1", pytest.param("rewire", marks=pytest.mark.slow)]
)
def test_one_trace_for_all_tasks(method):
    with compiles() as counts:
        sequence(method, len(TASKS))
    assert_once(counts, "episodes", *["candidates"] * (method == "rewire"))
    with compiles() as counts:
        sequence(method, 2)
    assert not counts
