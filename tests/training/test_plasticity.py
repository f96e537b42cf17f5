import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewire_jax
from rewire_jax.core.settings import SacSettings
from rewire_jax.core.transition import Batch
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.methods import find_method
from rewire_jax.methods.round import Round
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.training import critic_penalties, plasticity, random_keys, sac
from tests.each_method import each

SPEC = Spec(observations=3, actions=2, hidden=6, depth=2, tasks=3)
SETTINGS = SacSettings(
    hidden=SPEC.hidden, depth=SPEC.depth, batch_size=8, redo_every=10
)
KEY = jax.random.key(5)
REPORTING = "rewire", "csp", "pnn", "reset_distill"  # a policy of their own kind
DEAD = {"critic": [(0, 0, 2), (0, 1, 2), (1, 1, 4)], "policy": [(0, 1), (1, 3)]}
"""Critic, layer and neuron; and those of the policy."""


def make(name, network="mlp"):
    quick = rewire_jax.preset(make_scenario("probe/reach"), name, "quick")
    spec = SPEC._replace(network=network)
    return find_method(name).make(spec, quick.options.checked())


def batch_for(method, state):
    random = np.random.default_rng(0)
    size = SETTINGS.batch_size
    observation = random.normal(size=(size, 3)).astype(np.float32)
    return Batch(
        observation=observation,
        action=random.uniform(-1, 1, (size, 2)).astype(np.float32),
        reward=observation[:, 0],
        terminal=np.zeros(size, bool),
        truncated=np.zeros(size, bool),
        next_observation=observation,
        extras=method.extras(KEY, state, None, np.zeros(size, int)),
    )


def killed(layers, place):
    """The layers, with a neuron that hardly reacts to its inputs."""
    *rest, layer, neuron = place
    at = (*rest, neuron)
    weight, bias = layers[layer]
    dead = networks.Linear(
        weight.at[at].multiply(1e-3), bias.at[at].set(1e-4 * (neuron + 1))
    )
    return (*layers[:layer], dead, *layers[layer + 1 :])


def prepared(name, key=KEY):
    """A method, and a learner with dead neurons and moments that are not 0."""
    method = make(name)
    learner = jax.jit(lambda key: sac.init(key, method, SPEC, SETTINGS))(key)
    critic, params = learner.critic, learner.params
    for place in DEAD["critic"]:
        critic = killed(critic, place)
    if method.redo_policy:
        for place in DEAD["policy"]:
            params = killed(params, place)
    random = np.random.default_rng(1)

    def moments(state):
        filled = jax.tree.map(
            lambda x: jnp.asarray(random.uniform(1, 2, x.shape), jnp.float32),
            (state.mu, state.nu),
        )
        return state._replace(mu=filled[0], nu=filled[1])

    policy, critics, temperature = learner.optimizers
    return method, learner._replace(
        params=params,
        critic=critic,
        target=jax.tree.map(lambda x: x + 1, critic),
        optimizers=(moments(policy), moments(critics), temperature),
    )


def redo(learner, method, before, after, key=KEY):
    batch = batch_for(method, learner.method_state)
    made = Round(jnp.asarray(before), jnp.asarray(after), {})
    return plasticity.redo_in_time(
        key, learner, lambda key: batch, made, method, SETTINGS
    )


def touched(shapes, dead):
    """For each layer where weights come in, where they go out, and the biases."""
    for number, (weight, bias) in enumerate(shapes):
        incoming, outgoing = np.zeros(weight.shape, bool), np.zeros(weight.shape, bool)
        biases = np.zeros(bias.shape, bool)
        for *rest, layer, neuron in dead:
            if layer == number:
                incoming[(*rest, neuron)] = biases[(*rest, neuron)] = True
            if layer == number - 1:
                outgoing[(*rest, slice(None), neuron)] = True
        yield incoming, outgoing, biases


def check_reset(old, new, dead, fresh):
    """Exactly the dead neurons' numbers are new; `fresh` says whether they are 0."""
    for (incoming, outgoing, biases), before, after in zip(
        touched(old, dead), old, new, strict=True
    ):
        assert not np.asarray(after.weight)[outgoing].any()
        drawn = np.asarray(after.weight)[incoming & ~outgoing]
        bound = before.weight.shape[-1] ** -0.5
        if fresh:
            assert (np.abs(drawn) <= bound).all()
            assert len(set(drawn)) == len(drawn)
            assert drawn.size == 0 or np.abs(drawn).max() > bound / 4
            assert (after.bias[biases] != before.bias[biases]).all()
        else:
            assert not drawn.any()
            assert not np.asarray(after.bias)[biases].any()
        kept = ~(incoming | outgoing)
        np.testing.assert_array_equal(after.weight[kept], before.weight[kept])
        np.testing.assert_array_equal(after.bias[~biases], before.bias[~biases])


def equal(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize(
    "name", ["ft1", pytest.param("ewc", marks=pytest.mark.slow), "rewire"]
)
def test_exactly_the_dead_neurons_are_reset(name):
    method, learner = prepared(name)
    after = redo(learner, method, 8, 12)
    policy, critics, temperature = after.optimizers
    was_policy, was_critics, was_temperature = learner.optimizers
    check_reset(learner.critic, after.critic, DEAD["critic"], fresh=True)
    for moment in ("mu", "nu"):
        pair = getattr(was_critics, moment), getattr(critics, moment)
        check_reset(*pair, DEAD["critic"], fresh=False)
    assert method.redo_policy == (name == "ft1")
    if method.redo_policy:
        check_reset(learner.params, after.params, DEAD["policy"], fresh=True)
        for moment in ("mu", "nu"):
            pair = getattr(was_policy, moment), getattr(policy, moment)
            check_reset(*pair, DEAD["policy"], fresh=False)
    else:
        equal((policy, after.params), (was_policy, learner.params))
    changed = dict.fromkeys(("params", "critic", "optimizers"), ())
    equal(after._replace(**changed), learner._replace(**changed))
    equal(temperature, was_temperature)
    equal((policy.count, critics.count), (was_policy.count, was_critics.count))


def test_a_reset_hardly_changes_values_and_actions():
    method, learner = prepared("ft1")
    after = redo(learner, method, 8, 12)
    batch = batch_for(method, ())

    def seen(learner):
        q = sac.q_values(learner.critic, batch.observation, batch.action, "mlp")
        return q, method.act(learner.params, batch.observation)

    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=2e-3),
        seen(learner),
        seen(after),
    )


@pytest.mark.parametrize(
    ("before", "after", "due"),
    [(0, 4, False), (8, 12, True), (10, 14, False), (16, 20, True), (0, 64, True)],
)
def test_neurons_are_reset_in_time(before, after, due):
    method, learner = prepared("ft1")
    changed = redo(learner, method, before, after).critic
    assert np.array_equal(changed[0].weight, learner.critic[0].weight) != due


def test_members_are_reset_as_alone_and_the_branch_stays():
    method, learner = prepared("ft1")
    other = prepared("ft1", jax.random.key(6))[1]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), learner, other)
    keys = jax.random.split(KEY)

    def reset(key, learner, count):
        return redo(learner, method, count, count + 4, key)

    reset = jax.jit(reset)
    together = jax.vmap(reset, (0, 0, None))
    for number, alone in enumerate((learner, other)):
        mine = jax.tree.map(lambda leaf, n=number: leaf[n], together(keys, both, 8))
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6),
            mine,
            reset(keys[number], alone, 8),
        )
    jaxpr = jax.make_jaxpr(together)(keys, both, jnp.asarray(8))
    # Under a predicate of each member's own there would be none.
    (inner,) = jaxpr.eqns
    names = [e.primitive.name for e in inner.params["jaxpr"].eqns]
    assert names.count("cond") == 1


def test_a_key_for_resets_leaves_the_others_as_they_were():
    keys = random_keys.named(random_keys.UpdateKeys, KEY)
    for one, other in itertools.zip_longest(keys[:2], jax.random.split(KEY)):
        equal(jax.random.key_data(one), jax.random.key_data(other))


@pytest.mark.parametrize("name", each(REPORTING))
def test_every_method_reports_its_policy_in_training(name):
    network = "layer_norm"
    method = make(name, network)
    settings = dataclasses.replace(SETTINGS, network=network)
    learner = jax.jit(lambda key: sac.init(key, method, SPEC, settings))(KEY)
    params, state = learner.params, learner.method_state
    batch = batch_for(method, state)
    hidden = method.hidden(params, state, batch.observation)
    policy = method.policy(params, state, jnp.asarray(0))
    head = params.layers[-1] if name == "pnn" else policy[-1]
    output = networks.gaussian(networks.affine(head, hidden[-1]))
    played = method.act(policy, batch.observation)
    np.testing.assert_allclose(output, played, rtol=1e-4, atol=1e-5)

    found = plasticity.metrics(learner, batch, method, settings)
    activations = plasticity.critic_activations(learner, batch, method, settings)
    inputs = method.critic_input(batch.extras, batch.observation)
    q = sac.q_values(learner.critic, inputs, batch.action, network)
    for critic in range(2):
        head = jax.tree.map(lambda leaf, c=critic: leaf[c], learner.critic[-1])
        value = networks.affine(head, activations[-1][critic])[..., 0]
        np.testing.assert_allclose(value, q[critic], rtol=1e-4, atol=1e-5)
    for kind, layers in (("critic", activations), ("policy", hidden)):
        parts, ranks = [], []
        for layer in layers:
            size = np.abs(layer).mean(axis=-2)
            parts.append(size <= 0.025 * size.mean(axis=-1, keepdims=True))
        for matrix in np.asarray(layers[-1]).reshape(-1, *layers[-1].shape[-2:]):
            values = np.linalg.svd(matrix.astype(np.float64), compute_uv=False)
            shares = values[values > 0] / values.sum()
            ranks.append(np.exp(-np.sum(shares * np.log(shares))))
        assert found[f"dormant_{kind}"] == pytest.approx(np.mean(parts))
        assert found[f"rank_{kind}"] == pytest.approx(np.mean(ranks), rel=1e-3)


def test_dead_neurons_are_counted():
    method, learner = prepared("ft1")
    batch = batch_for(method, ())
    found = plasticity.metrics(learner, batch, method, SETTINGS)
    assert found["dormant_critic"] == pytest.approx(3 / (2 * 2 * 6))
    assert found["dormant_policy"] == pytest.approx(2 / (2 * 6))


def critic_gradient(critic=None, **penalty):
    """Of the critics' loss: Adam's first moments hold a tenth of the first gradient."""
    settings = dataclasses.replace(SETTINGS, **penalty)
    method = make("ft1")
    batch = batch_for(method, ())
    learner = jax.jit(lambda key: sac.init(key, method, SPEC, settings))(KEY)
    first = learner.critic
    learner = learner._replace(critic=critic or first)
    draw = sac.sample_update_noise(KEY, (), (), batch.action.shape, method, settings)
    metrics = sac.first_metrics(learner, batch, draw, method, settings)
    updated = jax.jit(sac.update, static_argnums=(5,))
    after, _ = updated(learner, metrics, batch, draw, 0, method, settings)
    equal(after.critic_start, learner.critic_start)
    return first, jax.tree.map(lambda m: 10 * m, after.optimizers[1].mu), after


def moved_critic(first):
    return jax.tree.map(lambda x: x + np.sin(np.arange(x.size)).reshape(x.shape), first)


def test_l2_init_pulls_critics_to_their_first_weights():
    first, _, after = critic_gradient()
    assert after.critic_start == ()
    moved = moved_critic(first)
    _, without, _ = critic_gradient(moved)
    _, pulled, after = critic_gradient(moved, l2_init=0.5)
    equal(after.critic_start, first)
    jax.tree.map(
        lambda without, pulled, w, start: np.testing.assert_allclose(
            pulled - without, 2 * 0.5 * (w - start), rtol=1e-3, atol=1e-3
        ),
        *(without, pulled, moved, first),
    )


def test_parseval_pulls_hidden_layers_to_orthogonal_ones():
    first, *_ = critic_gradient()
    moved = moved_critic(first)
    _, without, _ = critic_gradient(moved)
    _, pulled, _ = critic_gradient(moved, parseval=1e-3)
    added = jax.tree.map(lambda a, b: np.asarray(a - b), pulled, without)
    for layer, change in zip(moved[:-1], added[:-1], strict=True):
        np.testing.assert_allclose(change.bias, 0, atol=1e-4)
        for weight, got in zip(np.asarray(layer.weight), change.weight, strict=True):
            n = len(weight)
            away = weight @ weight.T - 2 * np.eye(n)
            expected = 1e-3 * (64 / n) ** 2 * 4 * away @ weight
            assert np.abs(expected).max() > 0.1
            np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-3)
    for leaf in added[-1]:
        np.testing.assert_allclose(leaf, 0, atol=1e-4)


def test_parseval_of_orthogonal_layers_is_zero():
    rows, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))
    layer = networks.Linear(jnp.asarray(2**0.5 * rows)[None], jnp.ones((1, 6)))
    out = networks.Linear(jnp.ones((1, 1, 6)), jnp.ones((1, 1)))
    assert critic_penalties.parseval((layer, out)) < 1e-8
    twice = layer._replace(weight=2 * layer.weight)
    # W Wᵀ is 8 I there.
    expected = (64 / 6) ** 2 * 6 * 6**2
    np.testing.assert_allclose(
        critic_penalties.parseval((twice, out)), expected, rtol=1e-4
    )
