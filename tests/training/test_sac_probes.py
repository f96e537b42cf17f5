"""SAC learns the values and the actions of the probes, which are known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.settings import SacSettings
from rewire_jax.envs import probe
from rewire_jax.envs.base import Environment, Task
from rewire_jax.methods import find_method
from rewire_jax.methods.spec import Spec
from rewire_jax.training import loop_state, replay_buffer, rollout, sac, train_loop

# Probes with one-number observations and actions, learned side by side.
NAMES = [name for name in probe.NAMES if name != "reach"]
DISCOUNT = 0.8
SEEN = np.array([-1, -0.5, 0, 0.5, 1], np.float32)[:, None]


def mixture():
    """All probes as one environment, told apart by the task."""
    parts = [probe.make_domain(name).environment for name in NAMES]
    assert {(p.observation_size, p.action_size) for p in parts} == {(1, 1)}

    def reset(task, key):
        branches = [functools.partial(part.reset, task, key) for part in parts]
        return jax.lax.switch(task.physics, branches)

    def step(task, state, action):
        branches = [functools.partial(p.step, task, state, action) for p in parts]
        return jax.lax.switch(task.physics, branches)

    endless = parts[NAMES.index("endless")]
    return Environment(reset, step, 1, 1, endless.episode_length)


@pytest.mark.parametrize(
    "time_limit", ["terminal", pytest.param("bootstrap", marks=pytest.mark.slow)]
)
def test_probe_values_and_actions_are_learned(time_limit):
    environment = mixture()
    spec = Spec(observations=1, actions=1, hidden=32, depth=1, tasks=1)
    settings = SacSettings(
        lr_policy=5e-3,
        lr_critic=5e-3,
        lr_temperature=1e-9,
        initial_temperature=1e-3,  # so that entropy is worth nothing
        discount=DISCOUNT,
        target_rate=0.05,
        batch_size=32,
        policy_delay=2,
        target_delay=1,
        time_limit=time_limit,
    )
    entry = find_method("ft1")
    method = entry.make(spec, entry.preset("", 1, "paper"))
    config = loop_state.LoopConfig(
        envs=8, updates=4, warmup=12, random_steps=100, transitions=300
    )
    steps = 300

    @jax.jit
    def learn(tasks, keys):
        def begin(task, key):
            learner = sac.init(key, method, spec, settings)
            episodes = jax.vmap(lambda key: rollout.begin(environment, task, key))(
                jax.random.split(key, config.envs)
            )
            buffer = replay_buffer.create(
                episodes.state.observation,
                transitions=config.transitions,
                actions=1,
                episode_length=environment.episode_length,
            )
            collection = loop_state.CollectorState(buffer, episodes, ())
            return loop_state.RunnerState(learner, collection, jnp.asarray(True))

        def train(key, state, task):
            return train_loop.run_chunk(
                key,
                state,
                task,
                0,
                steps,
                environment=environment,
                method=method,
                settings=settings,
                config=config,
            )[0]

        state = jax.vmap(begin)(tasks, keys)
        learner = jax.vmap(train)(keys, state, tasks).learner

        def look(learner, seen):
            mean, _ = method.distribution(learner.params, (), (), seen)
            return mean, sac.q_values(learner.critic, seen, jnp.tanh(mean), "mlp")

        return jax.vmap(look, (0, None))(learner, SEEN)

    tasks = Task(
        np.arange(len(NAMES)),
        np.ones((len(NAMES), 1), np.float32),
        np.ones((len(NAMES), 1), np.float32),
    )
    mean, q = learn(tasks, jax.random.split(jax.random.key(0), len(NAMES)))
    action = dict(zip(NAMES, np.tanh(mean)[..., 0], strict=True))
    q = dict(zip(NAMES, np.asarray(q), strict=True))

    def worth(name, observation):
        return q[name][:, SEEN[:, 0] == observation]

    def near(values, wanted, within=0.1):
        np.testing.assert_allclose(values, np.full_like(values, wanted), atol=within)

    near(worth("constant", 0), 1)
    near(worth("observation", -1), -1)
    near(worth("observation", 1), 1)
    near(worth("discount", 0), DISCOUNT)
    near(worth("discount", 1), 1)
    near(action["action"][SEEN[:, 0] == 0], 0.5)
    near(worth("action", 0), 0)
    for seen in (-0.5, 0.0, 0.5):
        near(action["match"][SEEN[:, 0] == seen], seen, 0.15)
        near(worth("match", seen), 0)
    looks_on = {"terminal": 0.75, "bootstrap": 1}[time_limit]
    near(worth("endless", 0), 1 / (1 - looks_on * DISCOUNT), 0.2)
