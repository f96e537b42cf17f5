"""What the bench compares to is of our sizes and does what ours does.

It runs in the environment of `make setup-bench`.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs `make setup-bench`")
pytest.importorskip("sbx")
pytest.importorskip("rejax")

from experiments.speed import loops, peer_rejax, peer_sbx, peer_torch  # noqa: E402
from experiments.speed.part import Effort  # noqa: E402
from experiments.speed.updates import draw_batches, updates  # noqa: E402
from rewire_jax.envs.scenarios import make_scenario  # noqa: E402
from rewire_jax.methods import rewire_losses, wiring  # noqa: E402
from rewire_jax.nn.networks import Linear  # noqa: E402
from rewire_jax.nn.permutation import permute  # noqa: E402
from rewire_jax.training.run_setup import prepare  # noqa: E402

EFFORT = Effort(quick=True)


@pytest.fixture(scope="module")
def world():
    scenario = make_scenario(EFFORT.scenario)
    return scenario.environment, scenario.tasks[1].data


def numbers(tree):
    return sum(np.size(leaf) for leaf in jax.tree.leaves(tree))


def parameters(module):
    return sum(p.numel() for p in module.parameters())


def test_all_have_networks_of_one_size(world):
    settings = EFFORT.settings("ft1", depth=3)
    learner = updates(settings)[0][1]
    policy, critics = numbers(learner.params), numbers(learner.critic)
    sbx = peer_sbx.make(settings, *world).policy
    assert numbers(sbx.actor_state.params) == policy
    assert numbers(sbx.qf_state.params) == critics
    _, state = peer_rejax.make(settings, *world)
    assert numbers(state.actor_ts.params) == policy
    assert numbers(state.critic_ts.params) == critics
    plain = peer_torch.Learner(
        settings, world[0].observation_size, world[0].action_size
    )
    assert parameters(plain.policy) == policy
    assert parameters(plain.critics) == critics


def test_pytorch_trains_as_many_numbers_as_rewire(world):
    settings = EFFORT.settings("rewire", depth=3)
    params = updates(settings)[0][1].params
    rewired = peer_torch.Rewired(
        settings, world[0].observation_size, world[0].action_size
    )
    trained = sum(p.numel() for p in rewired.parameters() if p.requires_grad)
    # Theirs has no heads of earlier tasks.
    heads = numbers(params.heads)
    assert trained == numbers(params) - heads + heads // len(params.heads.bias)


def test_soft_sort_has_our_gradients():
    key = jax.random.key(3)
    x, weight = jax.random.normal(key, (2, 5, 7))
    scores = jax.random.uniform(key, (7,))

    def loss(x, scores):
        return jnp.sum(weight * permute(x, scores, 0.3) ** 2)

    ours = jax.grad(loss, (0, 1))(x, scores)
    theirs = [torch.tensor(np.array(a), requires_grad=True) for a in (x, scores)]
    permuted = theirs[0] @ peer_torch.soft_sort(theirs[1], 0.3).T
    (torch.tensor(np.array(weight)) * permuted**2).sum().backward()
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine, other.grad, rtol=1e-4, atol=1e-5)


def test_the_alignment_is_ours(world):
    settings = EFFORT.settings("rewire", depth=3)
    rewired = peer_torch.Rewired(
        settings, world[0].observation_size, world[0].action_size
    )
    with torch.no_grad():
        for parameter in (rewired.adapters, rewired.input_adapters):
            parameter.copy_(torch.rand_like(parameter))
        for layer in rewired.layers:
            layer.weight.add_(0.1)

    def ours(modules):
        return tuple(
            Linear(jnp.array(m.weight.detach().numpy()), jnp.array(m.bias.detach()))
            for m in modules
        )

    adapters = wiring.Adapters(
        jnp.array(rewired.adapters.detach()), jnp.array(rewired.input_adapters.detach())
    )
    expected = rewire_losses.alignment_loss(
        ours(rewired.layers[:-1]),
        ours(rewired.previous),
        adapters,
        settings.options.adapter_tau,
        expanded=True,
    )
    np.testing.assert_allclose(rewired.alignment().item(), expected, rtol=1e-4)


@pytest.mark.parametrize(
    "case",
    [loops.Case(name, *what) for name, p in loops.PEERS.items() for what in p.cases],
    ids=str,
)
def test_a_peer_learns_on_our_environment(case):
    settings = loops.settings_of(EFFORT, case)
    batches = draw_batches(prepare(settings).spec, settings.sac.batch_size)
    whole, alone = loops.make(EFFORT, case, batches)
    jax.block_until_ready(whole(2))
    jax.block_until_ready(alone(1))


def test_pytorch_finds_the_value_of_a_constant_reward(world):
    settings = EFFORT.settings("rewire", policy_delay=1, target_delay=1)
    sac = replace(settings.sac, discount=0.5, target_rate=0.2, lr_critic=1e-2)
    sac = replace(sac, initial_temperature=1e-6, lr_temperature=1e-9)
    learner = peer_torch.Learner(replace(settings, sac=sac), 3, 1)
    x, action = torch.randn(64, 3), torch.rand(64, 1) * 2 - 1
    batch = x, action, torch.ones(64), torch.zeros(64), torch.randn(64, 3)
    for _ in range(600):
        learner.update(batch)
    value = learner.critics(x, action).mean().item()
    assert value == pytest.approx(sac.reward_scale / (1 - 0.5), rel=0.1)
