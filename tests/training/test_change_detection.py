"""Surprise against a plain NumPy regression, and its deviation from earlier ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.training import change_detection, replay_buffer

ENVS, SIZE, ACTIONS, LENGTH, CHUNK = 3, 4, 2, 7, 5
STEPS = CHUNK * (change_detection.WINDOW + 1)
TIME = STEPS + 8  # the buffer holds some older steps, too


def filled(change: float = 0.0, seed: int = 0, wrong: float = 0.0):
    """A buffer of a noisy linear system that changes before the newest chunk.

    Terminal transitions lead to `wrong`. Also the transitions, oldest first.
    """
    random = np.random.default_rng(seed)
    dynamics = 0.1 * random.normal(size=(SIZE + ACTIONS, SIZE))
    observation = random.normal(size=(ENVS, SIZE)).astype(np.float32)
    buffer = replay_buffer.create(
        jnp.asarray(observation),
        transitions=TIME,
        actions=ACTIONS,
        episode_length=LENGTH,
    )
    made = []
    for time in range(TIME):
        changed = change if time >= TIME - CHUNK else 0.0
        action = random.normal(size=(ENVS, ACTIONS)).astype(np.float32)
        inputs = np.concatenate([observation, action], axis=1)
        after = observation * 0.9 + inputs @ (dynamics + changed)
        after = (after + 0.1 * random.normal(size=after.shape)).astype(np.float32)
        reward = (inputs.sum(axis=1) + random.normal(size=ENVS)).astype(np.float32)
        terminal = random.random(ENVS) < 0.05
        truncated = np.full(ENVS, (time + 1) % LENGTH == 0) & ~terminal
        fresh = random.normal(size=after.shape).astype(np.float32)
        following = np.where((terminal | truncated)[:, None], fresh, after)
        following = np.where(terminal[:, None], wrong, following).astype(np.float32)
        buffer = replay_buffer.add(
            buffer,
            jnp.asarray(time),
            action=jnp.asarray(action),
            reward=jnp.asarray(reward),
            terminal=jnp.asarray(terminal),
            truncated=jnp.asarray(truncated),
            final_obs=jnp.asarray(after),
            next_obs=jnp.asarray(following),
            episode_length=LENGTH,
        )
        outputs = np.concatenate([after - observation, reward[:, None]], axis=1)
        made.append((inputs, outputs, ~terminal))
        observation = following
    return buffer, made


def surprise(buffer) -> float:
    function = jax.jit(change_detection.surprise, static_argnums=(2, 3))
    return float(function(buffer, jnp.asarray(TIME), CHUNK, LENGTH))


def regression(made) -> float:
    """The score of the docstring, by augmented least squares in 64 bits."""
    steps = [
        (x[kept].astype(float), y[kept].astype(float)) for x, y, kept in made[-STEPS:]
    ]
    old, new = (
        [np.concatenate(part) for part in zip(*steps[rows], strict=True)]
        for rows in (slice(0, -CHUNK), slice(-CHUNK, None))
    )
    middle, spread, level = old[0].mean(0), old[0].std(0), old[1].mean(0)

    def standard(x):
        return (x - middle) / spread

    count = old[0].shape[1]
    ridge = np.sqrt(1e-3 * len(old[0])) * np.eye(count)
    inputs = np.concatenate([standard(old[0]), ridge])
    outputs = np.concatenate([old[1] - level, np.zeros((count, old[1].shape[1]))])
    weights = np.linalg.lstsq(inputs, outputs, rcond=None)[0]
    errors = [abs(y - level - standard(x) @ weights) for x, y in (old, new)]
    return float(np.log(errors[1] / np.median(errors[0], axis=0) + 0.1).mean())


@pytest.mark.parametrize("change", [0.0, 0.5])
def test_surprise_is_that_of_a_plain_regression(change: float) -> None:
    buffer, made = filled(change)
    assert surprise(buffer) == pytest.approx(regression(made), abs=1e-3)


def test_a_change_surprises() -> None:
    same = [surprise(filled(0.0, seed)[0]) for seed in range(10)]
    changed = [surprise(filled(0.5, seed)[0]) for seed in range(10)]
    assert min(changed) > max(same)


def test_terminal_transitions_do_not_count() -> None:
    assert surprise(filled()[0]) == pytest.approx(surprise(filled(wrong=1e3)[0]), abs=1)
    buffer, made = filled(wrong=1e3)
    assert surprise(buffer) == pytest.approx(regression(made), abs=1e-2)


def test_deviation() -> None:
    scores = np.random.default_rng(0).normal(size=50).tolist()
    first, median, third = np.quantile(scores[-20:], [0.25, 0.5, 0.75])
    expected = abs(3 - median) / ((third - first) / 1.35 + 0.02)
    assert change_detection.deviation(scores, 3) == pytest.approx(expected)
    assert change_detection.deviation(scores, float(median)) == 0
    # A single score far away, such as that of a change, is no new standard.
    assert change_detection.deviation([*scores[-19:], 1e6], 3) > expected / 2
    assert np.isnan(change_detection.deviation(scores[:9], 3))
    assert np.isfinite(change_detection.deviation(scores[:10], 3))
    assert np.isnan(change_detection.deviation(scores, float("nan")))
