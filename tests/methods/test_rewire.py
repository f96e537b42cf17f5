import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.methods import find_method, finetune
from rewire_jax.methods.rewire import rewire
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.methods.rewire_state import Context
from rewire_jax.methods.spec import Spec
from tests.rewired import (
    ACTIONS,
    DEPTH,
    KEY,
    OBSERVATION,
    QUIET,
    SLOTS,
    SPEC,
    K,
    N,
    after_tasks,
    assert_near,
    head_at,
    make,
    orders_of,
    play,
    trained,
)

# What is told about modes


def divergence(hidden, scores, head, observation=OBSERVATION):
    """Mean KL over pairs of modes, states and actions, one pair after the other."""
    policies = [play(hidden, orders_of(v), head, observation) for v in scores]
    pairs = []
    for i, (mean, log_std) in enumerate(policies):
        for j, (other, other_log_std) in enumerate(policies):
            if i == j:
                continue
            variance = np.exp(2 * np.float64(log_std))
            other_variance = np.exp(2 * np.float64(other_log_std))
            kl = np.log(other_variance / variance) / 2 - 0.5
            kl += (variance + (mean - other) ** 2) / (2 * other_variance)
            pairs.append(kl.sum(axis=-1).mean())
    return np.mean(pairs)


@pytest.mark.parametrize("learned", [0, 2])
def test_mode_divergence_against_a_loop_over_pairs(learned):
    rng = np.random.default_rng(29)
    method = make(dropout=0.3)  # must not be seen in it
    params, state = method.init(KEY)
    params = trained(rng, params)
    state = state._replace(learned=jnp.asarray(learned))
    told = method.inspect(params, state, OBSERVATION)
    head = head_at(params, learned)
    expected = divergence(params.hidden, params.scores, head)
    assert expected > 0.1
    np.testing.assert_allclose(told["mode_divergence"], expected, rtol=1e-4)
    # Not that of the other task's head.
    other = divergence(params.hidden, params.scores, head_at(params, 1))
    assert not np.isclose(expected, other, rtol=0.01)


def test_modes_that_are_not_in_use_have_no_part_in_the_divergence():
    params, state = make().init(KEY)
    params = trained(np.random.default_rng(31), params)
    told = {}
    for modes in (1, 2, 3):
        method = make(modes=modes, mode_slots=5)
        spare = np.full((2, *params.scores.shape[1:]), np.nan, np.float32)
        wide = params._replace(scores=np.concatenate([params.scores, spare]))
        told[modes] = method.inspect(wide, state, OBSERVATION)["mode_divergence"]
        if modes > 1:
            expected = divergence(
                params.hidden, params.scores[:modes], head_at(params, 0)
            )
            np.testing.assert_allclose(told[modes], expected, rtol=1e-4)
    assert told[1] == 0
    assert not np.isclose(told[2], told[3], rtol=0.01)


def test_equal_modes_are_not_apart():
    method = make()
    params, state = method.init(KEY)
    params = trained(np.random.default_rng(37), params)
    # The same order in other scores: the policy is the same.
    scores = np.stack([params.scores[0] * factor for factor in (1.0, 2.0, 0.5)])
    told = method.inspect(params._replace(scores=scores), state, OBSERVATION)
    assert told["mode_divergence"] == 0


# Variants (Table 3)


def test_alignment_off_is_a_distance_of_weights_and_moves_no_wiring():
    method, rng = make(alignment="off", alpha=0.0, beta=2.0), np.random.default_rng(20)
    params, state = after_tasks(method, 2, rng)
    began, state = method.start_task(KEY, params, state, 2)
    moved = trained(rng, began)._replace(adapters=began.adapters)

    def loss(params):
        context = Context(0, 0, QUIET, KEY)
        gaussian = method.distribution(params, state, context, OBSERVATION)
        return method.penalty(KEY, params, state, context, OBSERVATION, gaussian)[0]

    value, gradient = jax.value_and_grad(loss)(moved)
    gaps = jax.tree.map(np.subtract, moved.hidden, state.previous)
    squares = sum(np.sum(gap.astype(np.float64) ** 2) for gap in jax.tree.leaves(gaps))
    np.testing.assert_allclose(value, 2 * squares, rtol=1e-5)
    assert_near(
        jax.tree.leaves(gradient.hidden), [4 * gap for gap in jax.tree.leaves(gaps)]
    )
    for leaf in jax.tree.leaves((gradient.adapters, gradient.scores)):
        np.testing.assert_array_equal(leaf, 0)
    _, kept = method.end_task(moved, state, 2, None)
    np.testing.assert_array_equal(kept.orders[:2], state.orders[:2])
    stored = make().size(params, state) - method.size(params, state)
    assert stored == (2 * DEPTH - 1) * N


def test_without_caching_all_tasks_share_the_latest_wiring():
    method, rng = make(caching=False), np.random.default_rng(21)
    params, state = after_tasks(method, 3, rng)
    assert state.orders.shape == (1, DEPTH, N)
    assert np.any(state.orders[0] != np.arange(N))
    for task in range(3):
        played = method.act(method.policy(params, state, task), OBSERVATION)
        head = head_at(params, task)
        assert_near(played, play(params.hidden, state.orders[0], head))
    began, _ = method.start_task(KEY, params, state, 3)
    np.testing.assert_array_equal(orders_of(began.scores[0]), state.orders[0])
    cached = make()
    spared = cached.size(*cached.init(KEY)) - method.size(*method.init(KEY))
    assert spared == (SLOTS - 1) * DEPTH * N


def test_the_policy_may_have_a_width_of_its_own():
    method = make(width=9)
    params, state = method.init(KEY)
    assert params.scores.shape == (K, DEPTH, 9)
    same = make(SPEC._replace(hidden=9))
    assert method.size(params, state) == same.size(params, state)
    context = Context(0, 0, QUIET[:, :9], KEY)
    mean, _ = method.distribution(params, state, context, OBSERVATION)
    assert mean.shape == (7, ACTIONS)


# Sizes

# Observations, actions, heads, FACTS.md's figure or None, numbers stored by hand:
# 2 * hidden + (heads + 1) * head + 3 * 3 * 256 + 5 * 256 + heads * 3 * 256.
SIZE_TABLE = [
    ("HalfCheetah, brax v1", 18, 6, 4, 2.11, 294_972),
    ("HalfCheetah, brax v1", 18, 6, 2, 2.06, 287_268),
    ("HalfCheetah", 17, 6, 4, None, 294_460),
    ("HalfCheetah", 17, 6, 2, None, 286_756),
    ("Ant", 27, 8, 4, 2.13, 304_720),
    ("Ant", 27, 8, 2, 2.07, 294_960),
    ("Humanoid", 244, 17, 4, 2.155, 438_954),
]


@pytest.mark.parametrize("row", SIZE_TABLE, ids=lambda row: f"{row[0]}, {row[3]}")
def test_model_size(row):
    _, observations, actions, heads, published, stored = row
    hidden = observations * 256 + 256 + 2 * (256 * 256 + 256)
    head = 256 * 2 * actions + 2 * actions
    by_hand = 2 * hidden + (heads + 1) * head + 3 * 768 + 5 * 256 + heads * 768
    assert by_hand == stored
    spec = Spec(observations, actions, 256, 3, 8)
    baseline = finetune.ft1(spec, finetune.FinetuneSettings())
    params, state = jax.eval_shape(baseline.init, KEY)
    assert baseline.size(params, state) == hidden + head

    for places in (0, 5):  # spare places are not stored
        options = RewireSettings(head_slots=heads, mode_slots=places).checked()
        method = rewire(spec, options)
        params, state = jax.eval_shape(method.init, KEY)
        assert method.size(params, state) == stored
    if published:
        assert stored / (hidden + head) == pytest.approx(published, rel=0.01)


def test_base_sizes_as_published():
    for observations, actions, base in ((18, 6, 139_532), (27, 8, 142_864)):
        spec = Spec(observations, actions, 256, 3, 8)
        method = finetune.ft1(spec, finetune.FinetuneSettings())
        assert method.size(*jax.eval_shape(method.init, KEY)) == base


# Settings


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"modes": 0}, "--modes"),
        ({"modes": 4, "mode_slots": 3}, "--mode-slots"),
        ({"head_slots": 0}, "--head-slots"),
        ({"beta": -1.0}, "--beta"),
        ({"alpha": float("nan")}, "--alpha"),
        ({"noise": float("inf")}, "--noise"),
        ({"dropout": 1.0}, "--dropout"),
        ({"tau": 0.0}, "--tau"),
        ({"adapter_tau": -0.1}, "--adapter-tau"),
        ({"adapter_rate": -1.0}, "--adapter-rate"),
        ({"width": -1}, "--width"),
    ],
)
def test_senseless_settings_are_told(values, message):
    with pytest.raises(UserError, match=message):
        RewireSettings(**values).checked()


def test_presets():
    entry = find_method("rewire")
    cheetah = entry.preset("halfcheetah/forgetting", 4, "paper")
    assert (cheetah.tau, cheetah.noise, cheetah.dropout) == (1.0, 0.1, 0.0)
    assert (cheetah.alpha, cheetah.beta, cheetah.head_slots) == (1e-5, 100.0, 4)
    ant = entry.preset("ant/robustness", 2, "paper")
    assert (ant.tau, ant.noise, ant.dropout) == (0.1, 0.0, 0.1)
    assert (ant.alpha, ant.beta, ant.head_slots) == (1e-5, 0.1, 2)
    assert entry.preset("my/own", 7, "paper").head_slots == 7
    assert cheetah.modes == 3
    assert cheetah.checked().mode_slots == 3
