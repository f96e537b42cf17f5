import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rewire_jax.training import replay_buffer

ENVS = 3
WIDTHS = {"observation": 2, "action": 1}


class Ledger:
    """Environments that number their observations and actions, and a plain list."""

    def __init__(self, transitions, episode_length, ends, seed=0):
        self.random = np.random.default_rng(seed)
        self.length, self.ends = episode_length, ends
        self.number = 0
        self.steps = np.zeros(ENVS, int)
        self.observation = self.observations()
        self.rows = []
        self.kept = transitions
        self.buffer = replay_buffer.create(
            jnp.asarray(self.observation),
            transitions=transitions,
            actions=WIDTHS["action"],
            episode_length=episode_length,
        )
        self.add = jax.jit(
            functools.partial(replay_buffer.add, episode_length=episode_length),
            donate_argnums=0,
        )
        self.sample = jax.jit(replay_buffer.sample, static_argnums=(3, 4))

    def observations(self):
        """`[ENVS, 2]`, never seen before."""
        self.number += ENVS
        column = np.arange(self.number, self.number + ENVS)
        return np.stack([column, -column], 1).astype(np.float32)

    def step(self):
        time = len(self.rows)
        self.steps += 1
        terminal = self.random.uniform(size=ENVS) < self.ends
        truncated = ~terminal & (self.steps >= self.length)
        ended = terminal | truncated
        last, fresh = self.observations(), self.observations()
        following = np.where(ended[:, None], fresh, last)
        action = (ENVS * time + np.arange(ENVS, dtype=np.float32))[:, None]
        reward = -action[:, 0] / 2
        self.rows.append(
            [
                (self.observation[e], reward[e], terminal[e], truncated[e], last[e])
                for e in range(ENVS)
            ]
        )
        self.buffer = self.add(
            self.buffer,
            time,
            action=action,
            reward=reward,
            terminal=terminal,
            truncated=truncated,
            final_obs=last,
            next_obs=following,
        )
        self.steps[ended] = 0
        self.observation = following

    def draw(self, count, key):
        return self.sample(self.buffer, key, len(self.rows), count, self.length)


@pytest.mark.parametrize(
    ("transitions", "episode_length", "ends"),
    [
        (7, 4, 0.15),
        (8, 4, 0.0),
        (5, 12, 0.0),
        (9, 1, 0.0),
        (1, 3, 0.3),
    ],
)
def test_samples_are_the_transitions_of_a_plain_list(transitions, episode_length, ends):
    ledger = Ledger(transitions, episode_length, ends)
    cuts = 0
    for time in range(1, 12 * max(transitions, episode_length) + 2):
        ledger.step()
        if time > 3 * transitions and time % 3:
            continue  # every fill level, then some of many rounds
        batch = jax.tree.map(np.asarray, ledger.draw(1000, jax.random.key(time)))
        number = batch.action[:, 0].astype(int)
        first = max(time - transitions, 0)
        assert set(number) == set(range(ENVS * first, ENVS * time))
        chosen = [ledger.rows[n // ENVS][n % ENVS] for n in number]
        columns = map(np.stack, zip(*chosen, strict=True))
        observation, reward, terminal, truncated, last = columns
        np.testing.assert_array_equal(batch.observation, observation)
        np.testing.assert_array_equal(batch.reward, reward)
        np.testing.assert_array_equal(batch.terminal, terminal)
        np.testing.assert_array_equal(batch.truncated, truncated)
        # Behind a terminal end there is nothing that may matter.
        going = ~terminal
        np.testing.assert_array_equal(batch.next_observation[going], last[going])
        cuts += truncated.sum()
    assert cuts > 0 or ends > 0


def test_sampling_is_uniform_over_the_valid_transitions():
    ledger = Ledger(transitions=6, episode_length=4, ends=0.2)
    for time in (1, 4, 6, 7, 20):
        while len(ledger.rows) < time:
            ledger.step()
        batch = ledger.draw(20_000, jax.random.key(time))
        counts = np.unique(np.asarray(batch.action), return_counts=True)[1]
        assert len(counts) == ENVS * min(time, 6)
        assert stats.chisquare(counts).pvalue > 1e-4
        again = ledger.draw(20_000, jax.random.key(time))
        np.testing.assert_array_equal(batch.action, again.action)


def test_every_observation_is_stored_once():
    envs, size, actions, steps, length = 128, 27, 8, 7812, 1000
    shapes = jax.eval_shape(
        lambda: replay_buffer.create(
            jnp.zeros((envs, size)),
            transitions=steps,
            actions=actions,
            episode_length=length,
        )
    )
    observations = shapes.observation.size + shapes.final.size
    # Above one for each step there is the last one, and one for each cut.
    assert shapes.observation.size == (steps + 1) * envs * size
    assert observations < 1.002 * steps * envs * size
    total = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    assert total < 1.002 * steps * envs * (size + actions + 3)
    flags = shapes.terminal, shapes.truncated
    assert {flag.dtype for flag in flags} == {jnp.dtype(bool)}


def test_members_have_buffers_of_their_own():
    @jax.jit
    @jax.vmap
    def play(value):
        buffer = replay_buffer.create(
            jnp.zeros((ENVS, 2)), transitions=3, actions=1, episode_length=2
        )
        buffer = replay_buffer.add(
            buffer,
            0,
            action=jnp.full((ENVS, 1), value),
            reward=jnp.full(ENVS, value),
            terminal=jnp.zeros(ENVS, bool),
            truncated=jnp.ones(ENVS, bool),
            final_obs=jnp.full((ENVS, 2), 10 + value),
            next_obs=jnp.full((ENVS, 2), 20 + value),
            episode_length=2,
        )
        return buffer, replay_buffer.sample(buffer, jax.random.key(0), 1, 8, 2)

    values = np.arange(2, dtype=np.float32)
    buffers, batch = play(values)
    expected = np.broadcast_to(values[:, None], (2, 8))
    np.testing.assert_array_equal(batch.reward, expected)
    np.testing.assert_array_equal(batch.next_observation[..., 0], 10 + expected)
    np.testing.assert_array_equal(
        np.asarray(buffers.observation)[:, 1, 0, 0], 20 + values
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"action": jnp.zeros((ENVS, WIDTHS["action"] + 1))},
        {"reward": jnp.zeros((ENVS, 1))},
        {"next_obs": jnp.zeros((ENVS, 3))},
        {"final_obs": jnp.zeros(2)},
        {"terminal": jnp.zeros(ENVS)},
    ],
)
def test_what_does_not_fit_is_refused(wrong):
    buffer = replay_buffer.create(
        jnp.zeros((ENVS, 2)), transitions=4, actions=WIDTHS["action"], episode_length=2
    )
    right = {
        "action": jnp.zeros((ENVS, WIDTHS["action"])),
        "reward": jnp.zeros(ENVS),
        "terminal": jnp.zeros(ENVS, bool),
        "truncated": jnp.zeros(ENVS, bool),
        "final_obs": jnp.zeros((ENVS, 2)),
        "next_obs": jnp.zeros((ENVS, 2)),
    }
    replay_buffer.add(buffer, 0, **right, episode_length=2)
    with pytest.raises(AssertionError):
        replay_buffer.add(buffer, 0, **right | wrong, episode_length=2)
