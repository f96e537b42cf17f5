import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.settings import SacSettings
from rewire_jax.methods import find_method
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.training import replay_buffer, sac

SPEC = Spec(observations=3, actions=2, hidden=4, depth=2, tasks=1)
SETTINGS = SacSettings(
    lr_policy=1e-2,
    lr_critic=2e-2,
    lr_temperature=3e-2,
    reward_scale=3.0,
    target_multiplier=1.5,
    initial_temperature=0.7,
    discount=0.9,
    target_rate=0.1,
    hidden=SPEC.hidden,
    depth=SPEC.depth,
    batch_size=6,
    policy_delay=3,
    target_delay=2,
)
NOISE = 0.3
PENALTY = 0.05


def make_method(spec):
    """FT-1 with a penalty of its own."""
    method = find_method("ft1").make(spec, find_method("ft1").preset("", 1, "paper"))

    def penalty(key, params, memory, context, observation, gaussian):
        value = sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(params))
        return PENALTY * value, {"squares": value}

    return method._replace(penalty=penalty)


METHOD = make_method(SPEC)


@jax.jit
def update(learner, metrics, batch, count, settings):
    return sac.update(
        learner, metrics, batch, drawn(batch, settings), count, METHOD, settings
    )


def drawn(batch, settings):
    size = batch.action.shape
    return sac.sample_update_noise(jax.random.key(1), (), (), size, METHOD, settings)


@pytest.fixture(autouse=True)
def fixed_noise(monkeypatch):
    """Replaces the draw of actions, so that a test can derive the update anew."""

    def sample_action(noise, mean, log_std):
        raw = mean + jnp.exp(log_std) * NOISE
        return jnp.tanh(raw), log_density(raw, log_std, jnp)

    monkeypatch.setattr(networks, "sample_action", sample_action)


def log_density(raw, log_std, xp):
    gaussian = -0.5 * NOISE**2 - log_std - 0.5 * np.log(2 * np.pi)
    return xp.sum(gaussian - xp.log(1 - xp.tanh(raw) ** 2), axis=-1)


def learner_and_batch(settings=SETTINGS):
    """A learner whose targets are not its critics, and transitions with all ends."""
    random = np.random.default_rng(0)
    learner = jax.jit(lambda key: sac.init(key, METHOD, SPEC, settings))(
        jax.random.key(0)
    )
    learner = learner._replace(
        target=jax.tree.map(
            lambda x: x + 0.3 * random.normal(size=x.shape).astype(np.float32),
            learner.target,
        )
    )
    size = settings.batch_size
    numbers = random.normal(size=(size, 2 * SPEC.observations + 1)).astype(np.float32)
    batch = replay_buffer.Batch(
        observation=numbers[:, :3],
        action=random.uniform(-1, 1, (size, SPEC.actions)).astype(np.float32),
        reward=numbers[:, 6],
        terminal=np.arange(size) == 1,
        truncated=(np.arange(size) >= 2) & (np.arange(size) < 4),
        next_observation=numbers[:, 3:6],
    )
    metrics = sac.first_metrics(
        learner, batch, drawn(batch, settings), METHOD, settings
    )
    return learner, batch, metrics


def wide(tree):
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)


def net(layers, x, network="mlp"):
    for number, (weight, bias) in enumerate(layers):
        x = x @ weight.T + bias
        if number < len(layers) - 1:
            if network == "layer_norm":
                variance = x.var(axis=-1, keepdims=True)
                x = (x - x.mean(axis=-1, keepdims=True)) / np.sqrt(variance + 1e-6)
            x = np.where(x > 0, x, 0.2 * x)
    return x


def both_q(critic, observation, action, network="mlp"):
    x = np.concatenate([observation, action], axis=-1)
    pair = [jax.tree.map(lambda leaf, i=i: leaf[i], critic) for i in (0, 1)]
    return np.stack([net(layers, x, network)[:, 0] for layers in pair])


def sample(params, observation):
    mean, log_std = np.split(net(params, observation), 2, axis=-1)
    raw = mean + np.exp(log_std) * NOISE
    return np.tanh(raw), log_density(raw, log_std, np)


def slopes(loss, tree):
    """The gradient by central differences, in float64."""
    leaves, structure = jax.tree.flatten(tree)

    def at(index, place, change):
        moved = [leaf.copy() for leaf in leaves]
        moved[index][place] += change
        return loss(structure.unflatten(moved))

    gradient = [np.zeros_like(leaf) for leaf in leaves]
    for index, leaf in enumerate(leaves):
        for place in np.ndindex(leaf.shape):
            up, down = at(index, place, 1e-5), at(index, place, -1e-5)
            gradient[index][place] = (up - down) / 2e-5
    return structure.unflatten(gradient)


def close(got, wanted, rtol=1e-3, atol=1e-5):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=atol),
        got,
        wanted,
    )


def same(one, other):
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return [bool(np.array_equal(a, b)) for a, b in pairs]


def first_adam_step(gradient, rate):
    return jax.tree.map(lambda g: -rate * g / (np.abs(g) + 1e-8), gradient)


@pytest.mark.parametrize(
    ("time_limit", "critic_entropy", "policy_states", "network"),
    [
        ("terminal", "sample", "current", "mlp"),
        ("bootstrap", "batch_mean", "current", "layer_norm"),
        ("terminal", "batch_mean", "both", "mlp"),
    ],
)
def test_one_update_is_what_the_formulas_say(
    time_limit, critic_entropy, policy_states, network
):
    settings = dataclasses.replace(
        SETTINGS,
        time_limit=time_limit,
        critic_entropy=critic_entropy,
        policy_states=policy_states,
        network=network,
    )
    q_values = functools.partial(both_q, network=network)
    learner, batch, metrics = learner_and_batch(settings)
    after, metrics = update(learner, metrics, batch, 0, settings)
    old, new, batch = wide(learner), wide(after), wide(batch)

    temperature = 0.7
    action, density = sample(old.params, batch.next_observation)
    soft = q_values(old.target, batch.next_observation, action).min(axis=0)
    if critic_entropy == "sample":
        soft = soft - temperature * density
    else:
        # As PyTorch does in the authors' code: [batch] - [batch, 1].
        soft = soft - temperature * density[:, None]
    going = 1 - batch.terminal
    if time_limit == "terminal":
        going = going * (1 - batch.truncated)
    target = 3 * batch.reward + 0.9 * going * soft

    def critic_loss(critic):
        q = q_values(critic, batch.observation, batch.action)
        return sum(np.mean((each - target) ** 2) for each in q)

    if critic_entropy == "sample":
        loss = critic_loss(old.critic)
        assert metrics["critic_loss"] == pytest.approx(loss, rel=1e-4)
    q = q_values(old.critic, batch.observation, batch.action)
    assert metrics["q"] == pytest.approx(q.mean(), rel=1e-4)
    # Adam's first moments hold a tenth of the first gradient.
    policy_state, critic_state, temperature_state = new.optimizers
    gradient = slopes(critic_loss, old.critic)
    close(jax.tree.map(lambda m: 10 * m, critic_state.mu), gradient)
    moved = jax.tree.map(np.add, old.critic, first_adam_step(gradient, 2e-2))
    close(new.critic, moved, atol=1e-4)

    states = batch.observation
    if policy_states == "both":
        states = np.concatenate([states, batch.next_observation])

    # The policy sees the critics that were just updated.
    def policy_loss(params, weight=PENALTY):
        action, density = sample(params, states)
        q = q_values(new.critic, states, action).min(axis=0)
        squares = sum(np.sum(leaf**2) for leaf in jax.tree.leaves(params))
        return np.mean(temperature * density - q) + weight * squares

    assert metrics["policy_loss"] == pytest.approx(policy_loss(old.params, 0), rel=1e-3)
    gradient = slopes(policy_loss, old.params)
    close(jax.tree.map(lambda m: 10 * m, policy_state.mu), gradient)
    moved = jax.tree.map(np.add, old.params, first_adam_step(gradient, 1e-2))
    close(new.params, moved, atol=1e-4)

    density = sample(old.params, states)[1]
    assert metrics["entropy"] == pytest.approx(-density.mean(), rel=1e-4)
    assert metrics["temperature"] == pytest.approx(temperature)

    def temperature_loss(log_temperature):
        return -np.mean(np.exp(log_temperature) * (density - 1.5 * SPEC.actions))

    gradient = slopes(temperature_loss, old.log_temperature)
    close(10 * temperature_state.mu, gradient)
    step = first_adam_step(gradient, 3e-2)
    close(new.log_temperature, np.log(temperature) + step)

    mixed = jax.tree.map(lambda t, c: 0.9 * t + 0.1 * c, old.target, new.critic)
    close(new.target, mixed)


def test_policy_and_targets_move_in_their_turn():
    learner, batch, metrics = learner_and_batch()
    for count in range(7):
        before = learner
        seen = metrics
        learner, metrics = update(learner, metrics, batch, count, SETTINGS)
        assert not any(same(before.critic, learner.critic))
        policy = before.params, before.log_temperature
        policy_after = learner.params, learner.log_temperature
        names = [n for n in metrics if n not in ("critic_loss", "q")]
        assert set(names) == {"policy_loss", "entropy", "temperature", "squares"}
        old, new = [seen[n] for n in names], [metrics[n] for n in names]
        if count % 3 == 0:
            assert not any(same(policy, policy_after) + same(old, new))
        else:
            assert all(same(policy, policy_after) + same(old, new))
            assert all(same(before.optimizers[0], learner.optimizers[0]))
            assert all(same(before.optimizers[2], learner.optimizers[2]))
        moved = same(before.target, learner.target)
        assert not any(moved) if count % 2 == 0 else all(moved)
        assert metrics["critic_loss"] != seen["critic_loss"]


@pytest.mark.parametrize("multiplier", [-50.0, 50.0])
def test_temperature_rises_where_entropy_is_too_low(multiplier):
    settings = dataclasses.replace(SETTINGS, target_multiplier=multiplier)
    learner, batch, metrics = learner_and_batch(settings)
    after, metrics = update(learner, metrics, batch, 0, settings)
    wanted = -multiplier * SPEC.actions
    too_low = metrics["entropy"] < wanted
    assert too_low == (multiplier < 0)
    assert (after.log_temperature > learner.log_temperature) == too_low


def test_a_task_starts_with_fresh_optimisers_and_kept_critics():
    learner, batch, metrics = learner_and_batch()
    after, _ = update(learner, metrics, batch, 0, SETTINGS)
    again = sac.restart(after, SETTINGS)
    assert all(same(again.critic, after.critic) + same(again.target, after.critic))
    assert all(same(again.params, after.params))
    assert again.log_temperature == pytest.approx(np.log(0.7))
    assert all(same(again.optimizers, learner.optimizers))
    # The two critics do not start alike.
    weight = learner.critic[0].weight
    assert not np.any(weight[0] == weight[1])
