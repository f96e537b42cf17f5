"""What is refused before anything is trained."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import rewire_jax
from rewire_jax.core.errors import UserError
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.training.run_setup import prepare
from tests.tiny import tiny


@pytest.mark.parametrize("make", [prepare, rewire_jax.make_train])
def test_a_task_with_nan_is_named(make) -> None:
    scenario = make_scenario("probe/reach")
    first, second, *others = scenario.tasks
    goal = jnp.array([0.5, jnp.nan])
    bad = dataclasses.replace(second, data=second.data._replace(physics=goal))
    scenario = dataclasses.replace(scenario, tasks=(first, bad, *others))
    with pytest.raises(UserError, match=second.name):
        make(tiny(scenario), scenario)
    one = dataclasses.replace(tiny(scenario), tasks=1)
    make(one, scenario)  # which does not reach it


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None, "0.1"])
def test_settings_from_python_are_checked(value) -> None:
    good = tiny()
    for wrong in (
        dataclasses.replace(good, sac=dataclasses.replace(good.sac, discount=value)),
        dataclasses.replace(
            good, options=dataclasses.replace(good.options, beta=value)
        ),
        dataclasses.replace(good, interactions=value),
    ):
        for make in (prepare, rewire_jax.make_train):
            with pytest.raises(UserError, match="--"):
                make(wrong, make_scenario("probe/reach"))


def test_no_task_of_a_scenario_has_nan() -> None:
    for name in ("probe/reach", "halfcheetah/forgetting", "ant/transfer"):
        for task in make_scenario(name).tasks:
            assert not any(jnp.isnan(leaf).any() for leaf in jax.tree.leaves(task.data))
