import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.envs import probe
from rewire_jax.envs.base import TaskChange

KEY = jax.random.key(0)
NORTHEAST = TaskChange("northeast", extra={"goal": (0.5, 0.5)})
PLAIN = TaskChange("plain")


def make(name, change=None):
    domain = probe.make_domain(name)
    change = change or (NORTHEAST if name == "reach" else PLAIN)
    return domain.environment, domain.make_task(change)


def play(name, policy, change=None, key=KEY):
    """Observations before, rewards and terminals after each step of an episode."""
    environment, task = make(name, change)
    state = environment.reset(task, key)
    seen, rewards, terminals = [], [], []
    for _ in range(environment.episode_length):
        seen.append(np.asarray(state.observation))
        action = jnp.asarray(policy(state.observation), jnp.float32)
        state = environment.step(task, state, action)
        rewards.append(float(state.reward))
        terminals.append(bool(state.terminal))
        if state.terminal:
            break
    return seen, rewards, terminals


def nothing(observation):
    return jnp.zeros(1)


@pytest.mark.parametrize("name", probe.NAMES)
def test_states_keep_their_type_and_are_pure(name):
    environment, task = make(name)
    first = environment.reset(task, KEY)
    action = jnp.ones(environment.action_size)
    second = environment.step(task, first, action)
    assert first.observation.shape == (environment.observation_size,)
    assert first.reward == 0
    assert not first.terminal
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
    again = jax.jit(environment.step)(task, first, action)
    jax.tree.map(np.testing.assert_allclose, again, second)
    assert probe.make_domain(name).environment is environment


def test_constant_is_worth_one():
    assert play("constant", nothing)[1:] == ([1.0], [True])


def test_observation_is_its_worth():
    values = set()
    for seed in range(8):
        seen, rewards, ends = play("observation", nothing, key=jax.random.key(seed))
        assert rewards == seen[0].tolist()
        assert ends == [True]
        values.add(rewards[0])
    assert values == {-1.0, 1.0}


def test_discount_rewards_the_second_step():
    seen, rewards, ends = play("discount", nothing)
    assert [s.item() for s in seen] == [0.0, 1.0]
    assert (rewards, ends) == ([0.0, 1.0], [False, True])


def test_action_is_best_at_a_half():
    grid = np.linspace(-1, 1, 41)
    rewards = [play("action", lambda _, a=a: jnp.array([a]))[1][0] for a in grid]
    assert grid[np.argmax(rewards)] == 0.5
    assert max(rewards) == 0
    assert min(rewards) == -2.25


def test_match_is_best_at_the_observation():
    seen = []
    for seed in range(4):
        key = jax.random.key(seed)
        observations, rewards, ends = play("match", lambda o: o, key=key)
        assert rewards == [0.0]
        assert ends == [True]
        assert play("match", lambda o: o + 0.1, key=key)[1][0] < 0
        seen.append(observations[0].item())
    assert len(set(seen)) == 4
    assert max(np.abs(seen)) <= 0.5


def test_endless_is_only_cut_off():
    assert play("endless", nothing)[1:] == ([1.0] * 4, [False] * 4)


def test_endless_has_two_values_by_how_the_cut_is_taken():
    gamma, bootstrapped, ended = 0.9, 0.0, 0.0
    _, rewards, _ = play("endless", nothing)
    for _ in range(500):  # one value for all steps, fitted to their mean target
        bootstrapped = np.mean([r + gamma * bootstrapped for r in rewards])
        last = len(rewards) - 1
        ended = np.mean([r + gamma * ended * (i < last) for i, r in enumerate(rewards)])
    np.testing.assert_allclose(bootstrapped, 1 / (1 - gamma))
    np.testing.assert_allclose(ended, 1 / (1 - 0.75 * gamma))


def test_reach_by_the_documented_best_action():
    goal = np.array([0.5, 0.5])

    def best(position):
        return jnp.clip((goal - position) / probe.REACH_STRIDE, -1, 1)

    seen, rewards, ends = play("reach", best)
    assert len(rewards) == 20
    assert not any(ends)
    np.testing.assert_allclose(seen[-1], goal, atol=1e-5)
    np.testing.assert_allclose(rewards[-1], 0, atol=1e-8)
    assert all(a <= b for a, b in itertools.pairwise(rewards))
    rng = np.random.default_rng(0)
    for _ in range(10):
        other = play("reach", lambda p: best(p) * rng.uniform(-1, 1, 2))[1]
        assert sum(other) < sum(rewards)


def test_reach_tasks_conflict():
    there = TaskChange("southwest", extra={"goal": (-0.5, -0.5)})
    environment, northeast = make("reach")
    _, southwest = make("reach", there)
    assert environment is make("reach", there)[0]
    state = environment.reset(northeast, KEY)
    action = jnp.ones(2)
    a, b = (environment.step(t, state, action) for t in (northeast, southwest))
    np.testing.assert_array_equal(a.observation, b.observation)
    assert a.reward != b.reward
    centre = state._replace(inner=jnp.zeros(2))
    for sign in (1.0, -1.0):
        a, b = (
            environment.step(t, centre, sign * action).reward
            for t in (northeast, southwest)
        )
        assert (a - b) * sign > 0


def test_reach_keeps_to_the_square():
    seen, _, _ = play("reach", lambda _: jnp.ones(2))
    np.testing.assert_array_equal(seen[-1], [1, 1])


def test_masks_act():
    change = TaskChange(
        "crippled", actions={"x": 0.0, "y": -1.0}, hidden=0.5, extra=NORTHEAST.extra
    )
    environment, task = make("reach", change)
    start = environment.reset(task, KEY)
    state = environment.step(task, start, jnp.array([1.0, 0.5]))
    moved = state.inner - start.inner
    np.testing.assert_allclose(moved, [0, -0.05], atol=1e-6)
    hidden = np.asarray(task.observation_mask) == 0
    assert hidden.sum() == 1
    assert np.all(np.asarray(state.observation)[hidden] == 0)
    assert np.all(np.asarray(state.observation)[~hidden] != 0)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("nowhere", PLAIN, "reach"),
        ("reach", PLAIN, "goal"),
        ("reach", TaskChange("short", extra={"goal": (1.0,)}), "two coordinates"),
        ("action", NORTHEAST, "goal"),
        ("action", TaskChange("moon", gravity=0.5), "gravity"),
        ("action", TaskChange("heavy", bodies={"torso": 2.0}), "bodies"),
        ("action", TaskChange("legless", actions={"hip": 0.0}), "hip"),
    ],
)
def test_mistakes_are_told(name, change, message):
    with pytest.raises(UserError, match=message):
        make(name, change)
