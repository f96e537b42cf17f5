import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewire_jax
from rewire_jax.core.errors import UserError
from rewire_jax.core.pytrees import count
from rewire_jax.core.transition import Batch
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.methods import csp, csp_settings
from rewire_jax.methods.base import Selection, Spec, Tools
from rewire_jax.methods.csp_settings import CspSettings
from rewire_jax.nn import networks
from rewire_jax.nn.networks import Linear
from rewire_jax.run import train_run
from tests.tiny import tiny

OBSERVATIONS, ACTIONS, TASKS = 3, 2, 4
SPEC = Spec(OBSERVATIONS, ACTIONS, hidden=5, depth=2, tasks=TASKS)
KEY = jax.random.key(0)
SEARCH = {"samples": 16, "estimations": 5, "rollouts": 4}
OBSERVATION = np.random.default_rng(0).normal(size=(7, OBSERVATIONS))
OBSERVATION = OBSERVATION.astype(np.float32)


@functools.partial(jax.jit, static_argnums=(0, 1))
def call(name, purpose, options, *arguments):
    method = csp.csp(SPEC, options)
    if purpose:
        key, state, extras = arguments
        return method.context(key, state, purpose, extras)
    return getattr(method, name)(*arguments)


def make(**values):
    """The method, compiled; as in a run, its numbers are traced."""
    options = CspSettings(**SEARCH | values).checked()
    method = csp.csp(SPEC, options)
    traced = ("init", "distribution", "policy", "extras", "candidates", "end_task")

    def context(key, state, purpose, extras):
        return call("context", purpose, options, key, state, extras)

    return method._replace(
        context=context,
        **{name: functools.partial(call, name, None, options) for name in traced},
    )


def random_anchors(rng, number=TASKS):
    like, _ = make().init(KEY)
    return jax.tree.map(
        lambda x: rng.normal(size=(number, *x.shape)).astype(np.float32), like
    )


def in_training(rng, frozen, **values):
    """The method in a task that began with some frozen anchors, and these."""
    method = make(**values)
    params, state = method.init(KEY)
    anchors = random_anchors(rng)
    params = jax.tree.map(lambda x: x[frozen], anchors)

    def cut(x):
        used = np.arange(TASKS).reshape(-1, *[1] * (x.ndim - 1)) < frozen
        return np.where(used, x, np.zeros_like(x))

    return (
        method,
        params,
        state._replace(
            learned=jnp.int32(frozen),
            frozen=jnp.int32(frozen),
            anchors=jax.tree.map(cut, anchors),
            proposals=random_weights(rng, 4, frozen + 1),
        ),
        anchors,
    )


def random_weights(rng, rows, used):
    drawn = np.zeros((rows, TASKS), np.float32)
    drawn[:, :used] = rng.dirichlet(np.ones(used), rows)
    return drawn


def folded(anchors, weights):
    """The weighted sum of the anchors, in float64."""
    return jax.tree.map(
        lambda x: np.tensordot(np.asarray(weights, np.float64), x, 1), anchors
    )


def play(anchors, weights, observation):
    """One sample through the mixture of anchors, layer by layer: mean, log-std."""
    x = observation.astype(np.float64)
    for index, (weight, bias) in enumerate(anchors):
        x = np.where(x > 0, x, 0.2 * x) if index else x
        x = sum(
            w * (np.asarray(weight[a], np.float64) @ x + bias[a])
            for a, w in enumerate(weights)
        )
    return x[:ACTIONS], np.clip(x[ACTIONS:], -20, 2)


def assert_near(actual, expected, tolerance=2e-5):
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=tolerance, atol=tolerance),
        actual,
        expected,
    )


def assert_same(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


def selection(*after):
    return Selection(None, np.array(after, np.float32))


# Settings


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


def assert_on_simplex(weights, used):
    weights = np.asarray(weights)
    assert np.all(weights >= 0)
    np.testing.assert_allclose(weights.sum(-1), 1, atol=1e-6)
    assert np.all(weights[..., used:] == 0)


def assert_dirichlet(weights, concentration):
    """Means and variances are those of a Dirichlet distribution."""
    assert_on_simplex(weights, len(concentration))
    total = sum(concentration)
    mean = np.array(concentration) / total
    variance = mean * (1 - mean) / (total + 1)
    drawn = np.asarray(weights, np.float64)[:, : len(concentration)]
    error = np.sqrt(variance / len(drawn))
    assert np.all(np.abs(drawn.mean(0) - mean) <= 4.5 * error)
    np.testing.assert_allclose(drawn.var(0), variance, rtol=0.15)


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


def batch_of(observation):
    fields = dict.fromkeys(Batch._fields)
    action = jnp.zeros((len(observation), ACTIONS))
    return Batch(**fields | {"observation": observation, "action": action})


@pytest.mark.parametrize("frozen", [1, 3])
def test_the_search_proposes_the_best_of_either_simplex(frozen):
    rng = np.random.default_rng(6)
    method, params, state, _ = in_training(rng, frozen)
    slope = rng.normal(size=TASKS).astype(np.float32)
    weights, noise = [], []

    def sample(key, number):
        return batch_of(jax.random.normal(key, (number, OBSERVATIONS)))

    def q(context, observation, action):
        weights.append(context)
        jax.debug.callback(noise.append, observation[:, 0])
        value = context @ slope + observation[:, 0]
        return jnp.stack([value, -100 * value])

    kept, state = method.consolidate(KEY, params, state, frozen, Tools(sample, q))
    jax.effects_barrier()
    assert_same(kept, params)
    assert len(noise) == SEARCH["estimations"]
    assert len(np.unique(noise)) > SEARCH["samples"] * SEARCH["estimations"]
    drawn = np.asarray(weights[0])
    value = drawn @ slope + np.mean(noise, axis=0)
    halves = np.split(np.arange(len(value)), 2)
    best = [half[np.argsort(-value[half])[:2]] for half in halves]
    np.testing.assert_array_equal(state.proposals, drawn[np.concatenate(best)])
    for half, used in zip(halves, (frozen + 1, frozen), strict=True):
        assert len(half) == SEARCH["samples"]
        assert_on_simplex(drawn[half], used)
    assert np.all(drawn[halves[0]][:, frozen] > 0)


def test_the_search_draws_flatly():
    method, params, state, _ = in_training(
        np.random.default_rng(7), 2, samples=4000, estimations=1, distribution="peaked"
    )
    seen = []

    def q(context, observation, action):
        seen.append(context)
        return jnp.zeros((2, len(context)))

    def sample(key, number):
        return batch_of(jnp.zeros((number, OBSERVATIONS)))

    method.consolidate(KEY, params, state, 2, Tools(sample, q))
    assert_dirichlet(seen[0][:4000], [1, 1, 1])
    assert_dirichlet(seen[0][4000:], [1, 1])


def test_candidates_are_the_proposals_folded():
    rng = np.random.default_rng(8)
    for frozen in (0, 1, 3):
        method, params, state, anchors = in_training(rng, frozen)
        policies, valid = method.candidates(params, state, frozen)
        np.testing.assert_array_equal(valid, [frozen > 0] * SEARCH["rollouts"])
        for index, row in enumerate(state.proposals):
            policy = jax.tree.map(lambda x, i=index: x[i], policies)
            assert_near(policy, folded(anchors, row))
    assert method.in_budget
    assert not method.baseline


# Keeping an anchor


NAN = float("nan")


@pytest.mark.parametrize(
    ("after", "kept", "chosen"),
    [
        # The former subspace's best is 2: at improvement 0.5 more than 3 is needed.
        ((3.01, 1.0, 1.0, 2.0), True, 0),
        ((1.0, 3.01, 2.0, 1.0), True, 1),
        ((3.0, 1.0, 1.0, 2.0), False, 3),
        ((1.0, 2.99, 2.0, 1.0), False, 2),
        ((NAN, 2.0, 2.0, 1.0), False, 2),
        ((NAN, NAN, 1.0, 2.0), False, 3),
        ((NAN, 3.01, 2.0, NAN), True, 1),
        ((1.0, 2.0, NAN, NAN), True, 1),
    ],
)
def test_an_anchor_is_kept_if_it_helps(after, kept, chosen):
    method, params, before, anchors = in_training(
        np.random.default_rng(9), 2, improvement=0.5
    )
    following, state = method.end_task(params, before, 2, selection(*after))
    assert state.learned == 3
    assert state.frozen == 2 + kept
    assert method.size(following, state) == (2 + kept) * count(params)
    np.testing.assert_array_equal(state.best[2], before.proposals[chosen])
    used = anchors if kept else before.anchors
    for ours, theirs in zip(state.anchors, used, strict=True):
        assert_same(Linear(*(x[:3] for x in ours)), Linear(*(x[:3] for x in theirs)))
    even = (np.arange(TASKS) < 2 + kept) / (2 + kept)
    assert_near(following, folded(anchors, even))
    # A dropped anchor is nowhere, and the next one takes its slot.
    traces = np.concatenate([np.ravel(x) for x in jax.tree.leaves((following, state))])
    assert np.isin(params[1].weight, traces).all() == kept
    newer = jax.tree.map(lambda x: x + 1, params)
    _, later = method.end_task(newer, state, 3, selection(9.0, 0.0, 0.0, 0.0))
    assert later.frozen == 3 + kept
    assert_same(jax.tree.map(lambda x: x[2 + kept], later.anchors), newer)


@pytest.mark.parametrize("after", [None, (0.0, 0.0, 5.0, 5.0), (NAN,) * 4])
def test_the_first_anchor_is_always_kept(after):
    method = make()
    params, state = method.init(KEY)
    chosen = after if after is None else selection(*after)
    following, state = method.end_task(params, state, 0, chosen)
    assert (state.learned, state.frozen) == (1, 1)
    np.testing.assert_array_equal(state.best[0], [1, 0, 0, 0])
    assert_same(following, params)
    assert_same(method.policy(following, state, 0), params)


def test_without_selection_the_newest_anchor_is_the_policy():
    method, params, state, _ = in_training(np.random.default_rng(10), 2)
    following, state = method.end_task(params, state, 2, None)
    assert state.frozen == 3
    np.testing.assert_array_equal(state.best[2], [0, 0, 1, 0])
    assert_same(method.policy(following, state, 2), params)


# Policies of tasks


def test_policies_of_finished_tasks_never_change():
    rng = np.random.default_rng(11)
    method = make()
    params, state = method.init(KEY)
    for task in range(TASKS):
        assert_same(method.policy(params, state, task), params)
    policies, returns = [], [(9.0, 0.0, 1.0, 1.0), (0.0, 0.0, 5.0, 1.0)]
    for task in range(TASKS):
        params = jax.tree.map(
            lambda x: x + rng.normal(size=x.shape).astype(np.float32), params
        )
        frozen = int(state.frozen)
        proposals = random_weights(rng, 4, frozen + 1)
        proposals[2:] = random_weights(rng, 2, max(frozen, 1))
        state = state._replace(proposals=proposals)
        # The anchors of the second and the last task are kept, not the third's.
        params, state = method.end_task(
            params, state, task, selection(*returns[task == 2])
        )
        weights = state.best[task]
        policies.append(method.policy(params, state, task))
        assert_near(policies[-1], folded(state.anchors, weights))
        unused = np.arange(TASKS) >= int(state.frozen)
        assert_on_simplex(weights, int(state.frozen))
        planted = state._replace(
            anchors=jax.tree.map(
                lambda x, u=unused: np.where(
                    u.reshape(-1, *[1] * (x.ndim - 1)), np.float32(np.nan), x
                ),
                state.anchors,
            )
        )
        for one in (state, planted):
            for known, policy in enumerate(policies):
                assert_same(method.policy(params, one, known), policy)
            for unseen in range(task + 1, TASKS):
                assert_same(method.policy(params, one, unseen), policies[-1])
    assert state.frozen == 3


def test_a_diverged_anchor_leaves_older_policies_alone():
    method, params, state, _ = in_training(np.random.default_rng(12), 1)
    best = np.eye(TASKS, dtype=np.float32)
    state = state._replace(best=best)
    before = method.policy(params, state, 0)
    broken = jax.tree.map(lambda x: x * np.nan, params)
    following, state = method.end_task(broken, state, 1, None)
    assert_same(method.policy(following, state, 0), before)


# Members


def test_a_member_is_the_same_alone_and_in_a_crowd():
    def life(options, key):
        method = csp.csp(SPEC, options)
        slope = jax.random.normal(key, (TASKS,))
        tools = Tools(
            lambda key, number: batch_of(jax.random.normal(key, (number, 3))),
            lambda context, observation, action: jnp.stack(
                [context @ slope + observation[:, 0]] * 2
            ),
        )

        def one_task(carry, task):
            params, state, extras = carry
            draw_key, search_key = jax.random.split(jax.random.fold_in(key, task))
            extras = method.extras(draw_key, state, extras, jnp.array([1, 2]))
            outputs = method.distribution(params, state, extras, OBSERVATION[:2])
            params = jax.tree.map(lambda x: x * 1.1 + 0.01, params)
            params, state = method.consolidate(search_key, params, state, task, tools)
            proposed = method.candidates(params, state, task)
            returns = selection(1.3, 1.2, 1.0, 0.9)
            params, state = method.end_task(params, state, task, returns)
            policies = jax.vmap(method.policy, (None, None, 0))
            learned = policies(params, state, jnp.arange(TASKS))
            seen = extras, outputs, proposed, learned, method.size(params, state)
            return (params, state, extras), seen

        params, state = method.init(key)
        extras = method.extras(key, state, None, jnp.zeros(2, int))
        return jax.lax.scan(one_task, (params, state, extras), jnp.arange(3))

    def options(improvement, every):
        return CspSettings(
            **SEARCH,
            improvement=improvement,
            resample_every=every,
        )

    crowd = options(jnp.array([0.1, 0.5]), jnp.array([1, 100]))
    keys = jax.random.split(KEY, 2)
    together = jax.jit(jax.vmap(life))(crowd, keys)
    alone = jax.jit(life)
    for member in range(2):
        one = jax.tree.map(lambda x, m=member: x[m], crowd)
        expected = alone(one, keys[member])
        assert_near(jax.tree.map(lambda x, m=member: x[m], together), expected)
    np.testing.assert_array_equal(together[0][1].frozen, [3, 1])


# A run


def searching(**options):
    settings = tiny(method="csp")
    options = dataclasses.replace(settings.options, **SEARCH, **options)
    return dataclasses.replace(settings, selection_episodes=1, options=options)


@pytest.mark.slow
def test_a_run_keeps_its_budget_and_its_policies(tmp_path):
    scenario = make_scenario("probe/reach")
    settings = searching(resample_every=7)
    folder = train_run.train(settings, tmp_path / "run")
    lines = (folder / "results.jsonl").read_text().splitlines()
    last = json.loads(lines[-1])["interactions"]
    # Four episodes after each task; the first has but one anchor and no choice.
    search = 4 * scenario.environment.episode_length
    assert last["training"] + 4 * search == 4 * settings.interactions
    assert last["selection"] == 3 * search
    for seed in range(2):
        for task in range(4):
            outputs = [
                rewire_jax.load_policy(folder, task=task, seed=seed, stage=stage)(GRID)
                for stage in range(task, 4)
            ]
            for output in outputs:
                np.testing.assert_array_equal(output, outputs[0])


@pytest.mark.parametrize(("improvement", "anchors"), [(1e9, 1), (0.0, 4)])
def test_a_run_keeps_an_anchor_by_its_return(
    improvement, anchors, tmp_path, monkeypatch
):
    # Returns are above 0 here, and the newest anchor's proposals always play best.
    settings = searching(improvement=improvement)
    select = train_run.Run.select

    def ranked(self, now, learner, task, phase):
        returns, used = select(self, now, learner, task, phase)
        return jnp.broadcast_to(jnp.array([4.0, 3.0, 2.0, 1.0]), returns.shape), used

    monkeypatch.setattr(train_run.Run, "select", ranked)
    folder = train_run.train(settings, tmp_path / "run")
    lines = (folder / "results.jsonl").read_text().splitlines()
    assert {json.loads(line)["model_size"] for line in lines[-8:]} == {anchors}


GRID = np.random.default_rng(1).uniform(-1, 1, (5, 2)).astype(np.float32)
