import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.core.pytrees import count
from rewire_jax.methods import csp, csp_settings
from rewire_jax.methods.csp_settings import CspSettings
from rewire_jax.nn import networks
from tests.csp_parts import (
    ACTIONS,
    KEY,
    OBSERVATION,
    OBSERVATIONS,
    TASKS,
    assert_dirichlet,
    assert_near,
    assert_on_simplex,
    assert_same,
    folded,
    in_training,
    make,
    play,
    random_weights,
)


@pytest.mark.parametrize(
    "values",
    [
        {"width": -1},
        {"resample_every": 0},
        {"improvement": -0.1},
        {"improvement": float("nan")},
        {"improvement": float("inf")},
        {"estimations": 0},
        {"rollouts": 0},
        {"rollouts": 7},
        {"rollouts": 8, "samples": 3},
    ],
)
def test_settings_that_make_no_sense(values):
    name = list(values)[-1].replace("_", "-")
    with pytest.raises(UserError, match=f"--{name}"):
        CspSettings(**values).checked()


def test_presets_are_the_published_values():
    peaked = {f"{d}/{s}" for d in ("halfcheetah", "ant") for s in PEAKED}
    often = {"halfcheetah/transfer", "halfcheetah/robustness", "ant/compositionality"}
    names = [f"{d}/{s}" for d in ("halfcheetah", "ant") for s in BRAX_SERIES]
    for name in [*names, "humanoid/hard", "probe/reach", "continual_world/cw10"]:
        paper = csp_settings.preset(name, 4, "paper").checked()
        assert paper == CspSettings(
            distribution="peaked" if name in peaked else "flat",
            resample_every=20 if name in often else 100,
            improvement=0.1,
            samples=4096,
            estimations=1024,
            # Continual World's episodes are a fifth as long.
            rollouts=32 if name == "continual_world/cw10" else 8,
        )
        quick = csp_settings.preset(name, 4, "quick").checked()
        assert quick.distribution == paper.distribution
        assert quick.samples * quick.estimations < paper.samples * paper.estimations


BRAX_SERIES = ("forgetting", "transfer", "robustness", "compositionality")
PEAKED = ("forgetting", "transfer")


def test_an_anchor_has_the_width_asked_for():
    for width, expected in [(0, 5), (9, 9)]:
        method = make(width=width)
        params, state = method.init(KEY)
        assert [layer.bias.size for layer in params] == [expected] * 2 + [2 * ACTIONS]
        assert method.size(params, state) == count(params)


# Weights


@pytest.mark.parametrize("distribution", ["flat", "peaked"])
def test_half_of_the_environments_draw_from_each_simplex(distribution):
    for frozen in range(TASKS):
        method, _, state, _ = in_training(
            np.random.default_rng(1), frozen, distribution=distribution
        )
        key = jax.random.key(frozen)
        weights = method.extras(key, state, None, np.zeros(8000, int))
        last = (frozen + 1) ** 2 if distribution == "peaked" else 1
        assert_dirichlet(weights[:4000], [1] * frozen + [last])
        assert_dirichlet(weights[4000:], [1] * max(frozen, 1))
        policy = method.context(key, state, "policy", weights)
        assert policy.shape == weights.shape
        assert_dirichlet(policy, [1] * frozen + [last])
        # Fresh draws are neither the stored ones nor alike from key to key.
        other = method.context(jax.random.key(9), state, "policy", weights)
        if frozen:
            assert len(np.unique(weights[:4000], axis=0)) > 3990
            assert np.mean(np.all(policy == other, axis=-1)) < 0.01


def test_the_odd_environment_draws_from_the_new_simplex():
    method, _, state, _ = in_training(np.random.default_rng(1), 2)
    for envs, new in [(1, 1), (3, 2)]:
        weights = method.extras(KEY, state, None, np.zeros(envs, int))
        np.testing.assert_array_equal(weights[:, 2] > 0, np.arange(envs) < new)


def test_weights_are_held_between_draws():
    method, _, state, _ = in_training(np.random.default_rng(1), 2, resample_every=20)
    held = random_weights(np.random.default_rng(2), 8, 3)
    steps = np.array([0, 1, 19, 20, 21, 39, 40, 999])
    weights = method.extras(KEY, state, held, steps)
    drawn = np.any(weights != held, axis=-1)
    np.testing.assert_array_equal(drawn, np.isin(steps, [0, 20, 40]))
    assert_on_simplex(weights, 3)
    # All start anew in the first step, whatever was before.
    fresh = method.extras(jax.random.key(1), state, held, np.zeros(8, int))
    assert np.all(np.any(fresh != held, axis=-1))


def test_critics_see_the_stored_weights():
    method, _, state, _ = in_training(np.random.default_rng(1), 1)
    extras = random_weights(np.random.default_rng(2), 7, 2)
    for purpose in ("act", "critic"):
        assert_same(method.context(KEY, state, purpose, extras), jnp.array(extras))
    seen = method.critic_input(extras, OBSERVATION)
    assert seen.shape == (7, OBSERVATIONS + method.critic_extra)
    np.testing.assert_array_equal(seen[:, :OBSERVATIONS], OBSERVATION)
    np.testing.assert_array_equal(seen[:, OBSERVATIONS:], extras)
    assert method.fresh_critic


def test_the_authors_critics_see_redrawn_weights_at_the_next_action():
    method, _, state, _ = in_training(
        np.random.default_rng(1), 1, next_weights="redrawn"
    )
    extras = random_weights(np.random.default_rng(2), 500, 2)
    drawn = method.context(KEY, state, "critic", extras)
    assert drawn.shape == extras.shape
    assert not np.any(np.all(np.isclose(drawn, extras), axis=-1))
    assert_on_simplex(drawn, 2)
    same = method.context(jax.random.key(1), state, "act", extras)
    assert_same(same, jnp.array(extras))


# The mixture


@pytest.mark.parametrize("frozen", [0, 1, 3])
def test_distribution_mixes_the_layers_for_each_sample(frozen):
    rng = np.random.default_rng(3)
    method, params, state, anchors = in_training(rng, frozen)
    weights = random_weights(rng, 7, frozen + 1)
    got = method.distribution(params, state, weights, OBSERVATION)
    expected = [play(anchors, *pair) for pair in zip(weights, OBSERVATION, strict=True)]
    for values, rows in zip(got, zip(*expected, strict=True), strict=True):
        assert_near(values, np.stack(rows))
    one = method.distribution(params, state, weights[2], OBSERVATION[2])
    assert_near(one, expected[2])


def test_weights_shared_by_a_batch_make_one_plain_policy():
    rng = np.random.default_rng(4)
    method, params, state, anchors = in_training(rng, 2)
    for row in random_weights(rng, 3, 3):
        shared = np.broadcast_to(row, (7, TASKS))
        plain = jax.tree.map(jnp.float32, folded(anchors, row))
        assert_near(
            method.distribution(params, state, shared, OBSERVATION),
            networks.mlp_policy(plain, OBSERVATION),
        )
        assert_near(jax.jit(csp.fold)(anchors, row), plain)


@pytest.mark.parametrize("frozen", [0, 2])
def test_the_gradient_is_that_of_the_newest_anchor(frozen):
    rng = np.random.default_rng(5)
    method, params, state, anchors = in_training(rng, frozen)
    weights = random_weights(rng, 7, frozen + 1)

    def loss(gaussian):
        mean, log_std = gaussian
        return jnp.sum(mean**2) + jnp.sum(jnp.sin(log_std))

    @jax.jit
    @jax.grad
    def brute(stack):
        def one(row, x):
            for index, layer in enumerate(stack):
                x = networks.activate(x) if index else x
                x = sum(
                    row[a] * (layer.weight[a] @ x + layer.bias[a])
                    for a in range(frozen + 1)
                )
            return networks.gaussian(x)

        return loss(jax.vmap(one)(weights, OBSERVATION))

    @jax.jit
    @jax.grad
    def ours(params):
        return loss(method.distribution(params, state, weights, OBSERVATION))

    expected = jax.tree.map(lambda x: x[frozen], brute(anchors))
    assert_near(ours(params), expected, 1e-4)
    assert max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(expected)) > 0.1


# The search
