import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewire_jax
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.methods import csp
from rewire_jax.methods.base import Tools
from rewire_jax.methods.csp_settings import CspSettings
from rewire_jax.run import train_run
from tests.csp_parts import (
    KEY,
    OBSERVATION,
    SEARCH,
    SPEC,
    TASKS,
    assert_near,
    batch_of,
    selection,
)
from tests.tiny import tiny


@pytest.mark.slow
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


@pytest.mark.parametrize(
    ("improvement", "anchors"),
    [pytest.param(1e9, 1, marks=pytest.mark.slow), (0.0, 4)],
)
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
