import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.envs.base import Environment, State, Task
from rewire_jax.training import rollout

LENGTH = 5


class Physics(NamedTuple):
    """Of a counter that ends itself once its count reaches `[]` `limit`."""

    limit: float
    gain: float


def observe(start, count):
    return jnp.stack([start, count])


def reset(task, key):
    start = jnp.floor(jax.random.uniform(key, maxval=4.0))
    state = {"start": start, "count": jnp.zeros(())}
    return State(state, observe(start, 0.0), jnp.zeros(()), jnp.zeros((), bool))


def step(task, state, action):
    start, count = state.inner["start"], state.inner["count"] + 1
    return State(
        {"start": start, "count": count},
        observe(start, count),
        task.physics.gain * count + action[0],
        start + count >= task.physics.limit,
    )


COUNTER = Environment(reset, step, 2, 1, LENGTH)


def make_task(limit, gain=1.0):
    return Task(Physics(limit, gain), np.ones(1), np.ones(2))


@functools.partial(jax.jit, static_argnums=0)
def advance(environment, task, episode, action):
    return rollout.advance(environment, task, episode, action)


@pytest.mark.parametrize(
    ("own_end", "length"),
    # The own end wins where the time limit falls on the same step.
    [(1000, LENGTH), (LENGTH, LENGTH), (3, 3), (1, 1)],
)
def test_an_ended_episode_returns_to_its_own_start(own_end, length):
    key = jax.random.key(3)
    begun = rollout.begin(COUNTER, make_task(0.0), key)
    start = float(begun.state.observation[0])
    task = make_task(start + own_end)
    episode = begun
    for _ in range(3):
        score = 0.0
        for count in range(1, length + 1):
            action = np.full(1, 0.1 * count, np.float32)
            episode, seen = advance(COUNTER, task, episode, action)
            score += 1.1 * count
            ended = count == length
            assert seen.reward == pytest.approx(1.1 * count)
            assert seen.score == pytest.approx(score)
            assert bool(seen.terminal) == (count == own_end)
            assert bool(seen.truncated) == (ended and own_end > LENGTH)
            np.testing.assert_array_equal(seen.final_obs, [start, count])
            following = [start, 0 if ended else count]
            np.testing.assert_array_equal(seen.next_obs, following)
            assert int(episode.steps) == (0 if ended else count)
            assert episode.score == pytest.approx(0 if ended else score)
        jax.tree.map(np.testing.assert_array_equal, episode, begun)


def act(policy, observation):
    mean = observation @ policy["weights"] + policy["bias"]
    return mean[None], mean[None] + 100  # the spread must not matter


def test_episodes_are_those_of_a_plain_loop():
    members, rows, count = 2, 3, 4
    limits, gains = [100.0, 4.0, 1.0], [1.0, 2.0, -3.0]
    tasks = jax.tree.map(
        lambda *x: np.stack(x).astype(np.float32), *map(make_task, limits, gains)
    )
    random = np.random.default_rng(0)
    policies = {
        "weights": random.normal(size=(members, rows, 2)).astype(np.float32) / 3,
        "bias": random.normal(size=(members, rows)).astype(np.float32),
    }
    keys = jax.random.split(jax.random.key(1), (members, rows))
    play = jax.jit(functools.partial(rollout.episodes, COUNTER, act, count=count))
    result = play(tasks, policies, keys)
    assert result.returns.shape == result.lengths.shape == (members, rows, count)

    starts = jax.jit(
        lambda keys: jax.vmap(lambda key: reset(None, key).observation[0])(keys.ravel())
    )(jax.vmap(jax.vmap(lambda key: jax.random.split(key, count)))(keys))
    starts = np.asarray(starts).reshape(members, rows, count)
    assert len(set(starts.ravel())) == 4
    for place in np.ndindex(members, rows, count):
        member, row, _ = place
        total, length = 0.0, 0
        while length < LENGTH and (length == 0 or starts[place] + length < limits[row]):
            seen = np.array([starts[place], length])
            raw = seen @ policies["weights"][member, row]
            action = np.tanh(raw + policies["bias"][member, row])
            length += 1
            total += gains[row] * length + action
        assert result.lengths[place] == length
        assert result.returns[place] == pytest.approx(total, rel=1e-4, abs=1e-4)
    assert set(np.ravel(result.lengths)) >= {1, 4, LENGTH}


def test_what_follows_an_end_does_not_count():
    def end_once(task, state, action):
        after = step(task, state, action)
        count, limit = after.inner["count"], task.physics.limit
        reward = jnp.where(count > limit, jnp.nan, after.reward)
        return after._replace(reward=reward, terminal=count == limit)

    environment = COUNTER._replace(step=end_once)
    # The second row keeps the loop running.
    tasks = jax.tree.map(lambda *x: np.stack(x), make_task(2.0), make_task(4.0))
    policies = {"weights": np.zeros((1, 2, 2)), "bias": np.zeros((1, 2))}
    keys = jax.random.split(jax.random.key(1), (1, 2))
    play = jax.jit(functools.partial(rollout.episodes, environment, act, count=2))
    result = play(tasks, policies, keys)
    np.testing.assert_array_equal(result.lengths, [[[2, 2], [4, 4]]])
    np.testing.assert_allclose(result.returns, [[[3, 3], [10, 10]]])


def test_the_return_since_the_latest_reset():
    rows, count = 3, 5
    limits, gains = [100.0, 4.0, 1.0], [1.0, 2.0, -3.0]
    tasks = jax.tree.map(
        lambda *x: np.stack(x).astype(np.float32), *map(make_task, limits, gains)
    )
    policies = {"weights": np.zeros((1, rows, 2)), "bias": np.zeros((1, rows))}
    keys = jax.random.split(jax.random.key(1), (1, rows))
    play = jax.jit(functools.partial(rollout.since_reset, COUNTER, act, count=count))
    result = play(tasks, policies, keys)
    starts = jax.vmap(jax.vmap(lambda key: jax.random.split(key, count)))(keys)
    starts = np.asarray(
        jax.vmap(lambda key: reset(None, key).observation[0])(starts.ravel())
    ).reshape(1, rows, count)
    for place in np.ndindex(1, rows, count):
        total, steps, limit, gain = 0.0, 0, limits[place[1]], gains[place[1]]
        for _ in range(LENGTH - 1):
            if steps and starts[place] + steps >= limit:
                total, steps = 0.0, 0
            steps += 1
            total += gain * steps
        assert result.returns[place] == pytest.approx(total)
    np.testing.assert_array_equal(result.lengths, LENGTH - 1)
