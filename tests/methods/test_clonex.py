import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewire_jax
from rewire_jax.core.errors import UserError
from rewire_jax.core.transition import Batch
from rewire_jax.methods.base import Tools
from rewire_jax.methods.clonex import ClonexSettings, clonex
from rewire_jax.methods.round import Round
from rewire_jax.methods.spec import Spec
from rewire_jax.storage.run_results import read_run
from tests.tiny import tiny

SPEC = Spec(observations=3, actions=2, hidden=5, depth=2, tasks=5, updates=100)
KEY = jax.random.key(0)
SLOTS, STATES, C = 3, 16, 7.0
OPTIONS = ClonexSettings(
    coefficient=C, states=STATES, batch=32, head_slots=SLOTS, explore=0.1
).checked()
PLAIN = clonex(SPEC, OPTIONS)
JITTED = ("init", "start_task", "penalty", "adjust_gradient", "end_task", "candidates")
METHOD = PLAIN._replace(**{name: jax.jit(getattr(PLAIN, name)) for name in JITTED})
HIDDEN = (3 * 5 + 5) + (5 * 5 + 5)
HEAD = 5 * 4 + 4


def states(task):
    rng = np.random.default_rng(task)
    return rng.normal(size=(STATES, 3)).astype(np.float32)


@jax.jit
def store(params, state, task, states):
    """What the method stores of a task with these states in its buffer."""

    def sample(key, count):
        del key
        assert count == len(states) == STATES
        return Batch(states, *[None] * 6)

    no_critic = Tools(sample, lambda *_: pytest.fail("no critic is needed"))
    return METHOD.consolidate(KEY, params, state, task, no_critic)


def moved(params, seed=0):
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda x: x + rng.normal(0, 0.3, x.shape).astype(np.float32), params
    )


def after_tasks(number, move=True):
    """Parameters and state in the middle of a task."""
    params, state = METHOD.init(KEY)
    for task in range(number):
        params, state = METHOD.start_task(KEY, params, state, task)
        params = moved(params, task) if move else params
        params, state = store(params, state, task, states(task))
        params, state = METHOD.end_task(params, state, task, None)
    return METHOD.start_task(KEY, params, state, number)


def penalty(params, state):
    return METHOD.penalty(KEY, params, state, 0, None, None)[0]


# Cloning


def test_nothing_is_lost_right_after_a_task():
    params, state = after_tasks(0)
    assert penalty(params, state) == 0
    assert penalty(moved(params), state) == 0
    params, state = after_tasks(1)
    np.testing.assert_allclose(penalty(params, state), 0, atol=1e-4)
    value, metrics = METHOD.penalty(KEY, moved(params), state, 0, None, None)
    np.testing.assert_allclose(value, C * metrics["cloning"], rtol=1e-6)
    assert penalty(moved(params), state) > 1
    # The weights of the first task and then of the second: only it is lost.
    params, state = after_tasks(2)
    assert penalty(params, state) > 1


def test_the_loss_trains_shared_layers_and_heads_of_earlier_tasks():
    params, state = after_tasks(2)
    gradient = jax.grad(penalty)(moved(params), state)
    for leaf in jax.tree.leaves(gradient.hidden):
        assert np.abs(leaf).max() > 0
    for leaf in gradient.heads:
        largest = np.abs(leaf).reshape(SLOTS, -1).max(axis=1)
        assert (largest[:2] > 0).all()
        assert largest[2] == 0


def test_a_task_that_recurs_replaces_its_states():
    _, before = after_tasks(SLOTS)
    _, after = after_tasks(SLOTS + 1)
    for old, new in zip(before.memory, after.memory, strict=True):
        assert not np.array_equal(old[0], new[0])
        np.testing.assert_array_equal(old[1:], new[1:])
    np.testing.assert_array_equal(after.memory.observation[0], states(SLOTS))


def test_each_task_has_its_head_and_unknown_ones_the_latest():
    params, state = after_tasks(2)
    heads = [METHOD.policy(params, state, task)[-1] for task in range(5)]
    for task, slot in enumerate((0, 1, 1, 0, 1)):
        np.testing.assert_array_equal(heads[task].weight, params.heads.weight[slot])
    assert not np.array_equal(heads[0].weight, heads[1].weight)


@pytest.mark.parametrize("tasks", [0, 2, 5])
def test_sizes(tasks):
    params, state = after_tasks(tasks)
    assert METHOD.size(params, state) == HIDDEN + SLOTS * HEAD
    stored = min(tasks, SLOTS) * STATES * (3 + 2 + 2)
    assert METHOD.stored(params, state) == stored


# Clipping


def test_gradients_are_clipped_to_a_norm():
    params, state = METHOD.init(KEY)
    long = moved(jax.tree.map(jnp.zeros_like, params))
    leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(long)]
    norm = np.sqrt(sum((leaf**2).sum() for leaf in leaves))
    assert norm > 1
    clipped = jax.tree.leaves(METHOD.adjust_gradient(long, state))
    for leaf, now in zip(leaves, clipped, strict=True):
        np.testing.assert_allclose(now, leaf * OPTIONS.clip / norm, rtol=1e-5)
    short = jax.tree.map(lambda x: x * 0.09 / norm, long)
    for old, now in zip(
        jax.tree.leaves(short),
        jax.tree.leaves(METHOD.adjust_gradient(short, state)),
        strict=True,
    ):
        np.testing.assert_array_equal(now, old)


# Exploration by the best earlier policy


def acting(state, purpose="act"):
    return int(METHOD.context(KEY, state, purpose, ()))


def candidates(params, state, task):
    return METHOD.candidates(params, state, task).valid.tolist()


def test_the_best_earlier_head_acts_at_first():
    params, state = after_tasks(2)
    assert acting(state) == 2  # nothing is known of the others yet
    assert candidates(params, state, 2) == [True, True, False]
    _, told = METHOD.after_baseline(params, state, jnp.array([-3.0, -5.0, 0.0]))
    assert acting(told) == 0
    assert acting(told, "critic") == acting(told, "policy") == 2
    _, told = METHOD.after_baseline(params, state, jnp.array([jnp.nan, -5.0, 0.0]))
    assert acting(told) == 1
    for updates, head in ((9, 1), (10, 2)):
        _, later = METHOD.after_round(params, told, Round(0, updates, {}))
        assert acting(later) == head
    assert candidates(params, later, 2) == [False] * SLOTS
    _, fresh = METHOD.start_task(KEY, params, later._replace(learned=3), 3)
    assert acting(fresh) == 0


def test_the_first_task_has_nobody_to_learn_from():
    params, state = after_tasks(0)
    assert candidates(params, state, 0) == [False] * SLOTS
    _, told = METHOD.after_baseline(params, state, jnp.zeros(SLOTS))
    assert acting(told) == 0


def test_what_acts_is_the_explorers_policy():
    params, state = after_tasks(2)
    _, told = METHOD.after_baseline(params, state, jnp.array([-3.0, -5.0, 0.0]))
    observation = np.ones((4, 3), np.float32)
    context = METHOD.context(KEY, told, "act", ())
    got = METHOD.distribution(params, told, context, observation)
    expected = METHOD.act(METHOD.policy(params, told, 0), observation)
    np.testing.assert_array_equal(got, expected)


@pytest.mark.slow
def test_a_run_counts_what_it_plays_and_stores(tmp_path):
    settings = dataclasses.replace(tiny(method="clonex"), tasks=2, seeds=1)
    options = dataclasses.replace(settings.options, states=50)
    settings = dataclasses.replace(settings, options=options)
    folder = rewire_jax.train(settings, tmp_path / "run")
    rows = [
        json.loads(row) for row in (folder / "results.jsonl").read_text().splitlines()
    ]
    spec = json.loads((folder / "settings.json").read_text())["spec"]
    length = json.loads((folder / "settings.json").read_text())["episode_length"]
    hidden, inputs, outputs = spec["hidden"], spec["observations"], spec["actions"]
    plain = (inputs + 1) * hidden + (hidden + 1) * hidden + (hidden + 1) * 2 * outputs
    numbers = 50 * (inputs + 2 * outputs)
    for row in rows:
        # One earlier task is known at the start of the second.
        played = length * settings.selection_episodes * (row["stage"] == 1)
        assert row["interactions"]["selection"] == played
        stored = (row["stage"] + 1) * numbers / plain
        assert row.get("stored_states", 0) == pytest.approx(stored)
        assert ("stored_states" in row) == (row["stage"] >= 0)
    assert read_run(folder).stored_states == pytest.approx(2 * numbers / plain)
    report = rewire_jax.write_report([folder], tmp_path / "report")
    assert "stored states" in report.table.heads


@pytest.mark.parametrize(
    "wrong",
    [
        {"coefficient": -1.0},
        {"clip": 0.0},
        {"explore": 1.0},
        {"states": 0},
        {"batch": 0},
        {"head_slots": 0},
    ],
)
def test_settings_that_cannot_be(wrong):
    (name,) = wrong
    with pytest.raises(UserError, match="--" + name.replace("_", "-")):
        dataclasses.replace(OPTIONS, **wrong).checked()
