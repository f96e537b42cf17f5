"""Training as a pure function: what a run with a folder learns, as arrays."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewire_jax
from rewire_jax import UserError, make_act, make_scenario, make_train
from rewire_jax.training.acting import Learned
from tests.tiny import rows, tiny


def small(method: str = "rewire") -> rewire_jax.Settings:
    # 640 interactions are no multiple of a report: the last chunk is shorter.
    settings = dataclasses.replace(tiny(method=method), tasks=2, report_every=240)
    sac = dataclasses.replace(settings.sac, depth=1)
    settings = dataclasses.replace(settings, sac=sac)
    if method == "csp":
        options = dataclasses.replace(settings.options, samples=16, estimations=4)
        settings = dataclasses.replace(
            settings, selection_episodes=1, interactions=960, options=options
        )
    if method == "clonex":
        # At 100, rounding has larger effects.
        options = dataclasses.replace(settings.options, states=50, coefficient=1.0)
        settings = dataclasses.replace(settings, options=options)
    return settings


# Candidates chosen among; updates from the buffer at the end; labels and a budget that
# pays for the choice; a fresh critic and policies stored once; returns that are told at
# a task's start.
@pytest.mark.parametrize(
    "method",
    [
        "ft1",
        pytest.param("rewire", marks=pytest.mark.slow),
        pytest.param("packnet", marks=pytest.mark.slow),
        pytest.param("csp", marks=pytest.mark.slow),
        pytest.param("pnn", marks=pytest.mark.slow),
        pytest.param("clonex", marks=pytest.mark.slow),
    ],
)
def test_a_run_with_a_folder_comes_to_the_same(method: str, tmp_path: Path) -> None:
    settings = small(method)
    folder = rewire_jax.train(settings, tmp_path / "run")
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    made = jax.jit(jax.vmap(make_train(settings)))(keys)
    for row in rows(folder, "results.jsonl"):
        place = row["member"], row["stage"] + 1, row["task"]
        np.testing.assert_allclose(made.returns[place], row["return"], rtol=1e-4)
    reports = len(made.curves.interactions[0, 0])
    written = rows(folder, "training.jsonl")
    assert len(written) == 2 * 2 * reports
    for row in written:
        found = np.flatnonzero(made.curves.interactions[0, 0] == row["interactions"])
        place = row["member"], row["stage"], *found
        for name, values in made.curves.metrics.items():
            np.testing.assert_allclose(values[place], row[name], rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(made.curves.rewards[place], row["reward"], rtol=1e-4)
        ended = np.nan if row["return"] is None else row["return"]
        np.testing.assert_allclose(made.curves.returns[place], ended, rtol=1e-4)
    last = rows(folder, "results.jsonl")[-1]
    assert made.selection[1] == last["interactions"]["selection"]
    learned = rewire_jax.load_policies(folder).members
    for ours, theirs in zip(
        jax.tree.leaves(made.learned), jax.tree.leaves(learned), strict=True
    ):
        # Where ClonEx's loss is 0 but for rounding, Adam still takes steps.
        near = 1e-2 if method == "clonex" else 1e-4
        np.testing.assert_allclose(ours, theirs, atol=near)


def test_a_sweep_is_a_vmap_over_numbers() -> None:
    settings = small("ft1")
    train = make_train(settings)
    rates = jnp.array([settings.sac.lr_policy, 3e-3])

    def at(rate):
        return train(
            jax.random.key(0), sac=dataclasses.replace(settings.sac, lr_policy=rate)
        )

    both = jax.jit(jax.vmap(at))(rates)
    alone = jax.jit(train)(jax.random.key(0))
    np.testing.assert_allclose(both.returns[0, 0], both.returns[1, 0])  # untrained
    assert not np.allclose(both.returns[0, 1:], both.returns[1, 1:])
    np.testing.assert_allclose(both.returns[0], alone.returns, rtol=1e-4)


def test_what_was_learned_acts_as_it_was_evaluated() -> None:
    settings = dataclasses.replace(small("ft1"), eval_episodes=64)
    scenario = make_scenario(settings.scenario)
    made = jax.jit(make_train(settings, scenario))(jax.random.key(3))
    act, environment = make_act(settings, scenario), scenario.environment

    def episode(task, key):
        data = jax.tree.map(jnp.asarray, scenario.tasks[task].data)

        def step(carry, _):
            state, total, alive = carry
            action = act(made.learned, task, state.observation)
            state = environment.step(data, state, action)
            return (state, total + alive * state.reward, alive & ~state.terminal), None

        start = environment.reset(data, key), 0.0, jnp.asarray(True)
        length = environment.episode_length
        return jax.lax.scan(step, start, length=length)[0][1]

    for task in range(2):
        # Other episodes: what is learned acts like that within a few errors of a mean.
        keys = jax.random.split(jax.random.key(task), 64)
        returns = np.asarray(jax.vmap(lambda key, t=task: episode(t, key))(keys))
        error = 2 * returns.std() / np.sqrt(64)
        assert abs(returns.mean() - made.returns[-1, task]) < 4 * error + 1e-3


def test_environments_on_the_host_are_refused() -> None:
    from tests import walk

    scenario = walk.scenario(walk.walker())
    settings = tiny(scenario, "ft1")
    with pytest.raises(UserError, match="train"):
        make_train(settings, scenario)


@pytest.mark.parametrize(
    "task", [2, -1, np.int64(7), jnp.int32(9), 1.5, np.nan, True, "0", np.arange(2)]
)
def test_a_task_that_is_not_there_has_no_action(task: Any) -> None:
    settings = tiny(method="ft1")
    scenario = make_scenario("probe/reach")
    settings = dataclasses.replace(settings, tasks=2)
    with pytest.raises(ValueError, match="task"):
        make_act(settings, scenario)(Learned((), ()), task, jnp.zeros(2))


@pytest.mark.parametrize("key", [jax.random.PRNGKey(0), 0, None])
def test_a_key_of_another_kind_is_refused(key: Any) -> None:
    with pytest.raises(ValueError, match="key"):
        make_train(tiny(method="ft1"))(key)


@pytest.mark.parametrize(
    ("part", "changes", "said"),
    [
        ("sac", {"lr_policy": -1.0}, "--lr-policy"),
        ("sac", {"discount": np.nan}, "--discount"),
        ("sac", {"lr_critic": jnp.ones(2)}, "--lr-critic"),
        ("sac", {"lr_critic": "fast"}, "--lr-critic"),
        ("options", {"modes": 4}, "--modes"),
        ("sac", {"hidden": 32}, "--hidden"),
        ("sac", {"network": "layer_norm"}, "--network"),
        ("options", {"alignment": "off"}, "--alignment"),
        ("options", {"tau": jnp.float32(0)}, "--tau"),
    ],
)
def test_wrong_values_of_other_settings_are_refused(
    part: str, changes: dict[str, Any], said: str
) -> None:
    settings = small("rewire")
    given = {part: dataclasses.replace(getattr(settings, part), **changes)}
    with pytest.raises(UserError, match=said):
        make_train(settings)(jax.random.key(0), **given)


@pytest.mark.parametrize("part", ["sac", "options"])
@pytest.mark.parametrize("value", [small("rewire"), 0, {}])
def test_settings_of_another_class_are_refused(part: str, value: Any) -> None:
    with pytest.raises(UserError, match=part):
        make_train(small("rewire"))(jax.random.key(0), **{part: value})


# Traced settings must be single numbers, and a static one cannot be traced.
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("reward_scale", jnp.ones(1)),
        ("reward_scale", jnp.ones(32)),
        ("reward_scale", jnp.asarray(True)),
        ("batch_size", jnp.asarray(small("ft1").sac.batch_size)),
    ],
)
def test_values_that_cannot_be_traced_are_refused(name: str, value: jax.Array) -> None:
    settings = small("ft1")
    train = make_train(settings)

    def at(traced: jax.Array) -> Any:
        sac = dataclasses.replace(settings.sac, **{name: traced})
        return train(jax.random.key(0), sac=sac)

    with pytest.raises(UserError, match="--" + name.replace("_", "-")):
        jax.eval_shape(at, value)
