"""Choosing a policy without a task label, among policies that are made by hand."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewire_jax
from rewire_jax.core.errors import UserError
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.scenarios import Scenario, ScenarioSpec, make_scenario
from rewire_jax.run import task_choice
from rewire_jax.run.task_choice import Trials
from rewire_jax.training.run_setup import Plan, prepare
from tests import walk
from tests.compiles import compiles
from tests.tiny import small, tiny

# The first task recurs.
SCENARIO = make_scenario(
    ScenarioSpec(
        "probe/recurring",
        "reach",
        tuple(
            TaskChange(name, extra={"goal": goal})
            for name, goal in (
                ("northeast", (0.5, 0.5)),
                ("southwest", (-0.5, -0.5)),
                ("northeast", (0.5, 0.5)),
                ("southeast", (0.5, -0.5)),
            )
        ),
        repeats=1,
        interactions=640,
    )
)
# The third way is the first one's, but slower.
WAYS = [[2.0, 2.0], [-2.0, -2.0], [0.2, 0.2], [2.0, -2.0]]


def planned(scenario: Scenario = SCENARIO, method: str = "sac_n") -> Plan:
    settings = tiny(scenario, method)
    return prepare(dataclasses.replace(settings, tasks=len(scenario.tasks)), scenario)


def policies_of(plan: Plan) -> Any:
    return plan.program.policies(plan.stacked, plan.program.init(plan.stacked))


def steered(plan: Plan, directions: Any) -> Any:
    """Policies whose action is tanh of `directions` `[members, tasks, actions]`."""
    *hidden, last = jax.tree.map(jnp.zeros_like, policies_of(plan))
    directions = jnp.asarray(directions)
    bias = last.bias.at[..., : directions.shape[-1]].set(directions)
    return [*hidden, last._replace(bias=bias)]


def test_a_recurring_task_is_recognised_by_any_of_its_places() -> None:
    plan = planned()
    policies = steered(plan, [WAYS, WAYS[::-1]])
    with compiles() as counts:
        choice = task_choice.choose(plan, policies, 4, Trials(3, None, 0))
    assert set(choice.place[0, [0, 2]]) <= {0, 2}
    assert choice.place[0, 1] == 1
    assert choice.place[0, 3] == 3
    assert choice.recognised[0].all()
    # The other seed's policies are those of other tasks, except for northeast's.
    assert choice.place[1, 3] == 0
    assert not choice.recognised[1, [1, 3]].any()
    assert choice.trained.all()
    assert (choice.candidates == 4).all()
    assert (choice.interactions == (4 + 2) * 3 * 20).all()
    # A trace for each round: of four, and of two candidates.
    assert counts["episodes"] <= 2
    with compiles() as counts:
        task_choice.choose(plan, policies, 4, Trials(3, None, 1))
    assert counts["episodes"] == 0


def test_a_choice_does_not_depend_on_other_members() -> None:
    plan = planned()
    # Hardly different, so that chance decides.
    ways = [[0.01, 0.0], [0.0, 0.01], [0.01, 0.01], [0.0, 0.0]]
    fewer = [ways[0], ways[0], ways[1], ways[0]]
    both = [
        task_choice.choose(plan, steered(plan, x), 4, Trials(3, None, 5))
        for x in ([ways, ways], [ways, fewer])
    ]
    for one, other in zip(*both, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
    assert both[1].candidates.tolist() == [[4] * 4, [2] * 4]
    assert both[1].interactions.tolist() == [[(4 + 2) * 3 * 20] * 4, [2 * 3 * 20] * 4]
    assert set(both[1].place[1]) <= {0, 2}


def test_one_policy_is_chosen_at_no_cost() -> None:
    plan = planned(method="ft1")
    choice = task_choice.choose(plan, policies_of(plan), 4, Trials(3, None, 0))
    assert not choice.place.any()
    assert not choice.interactions.any()
    assert choice.recognised.all()
    assert (choice.candidates == 1).all()


def test_policies_of_trained_tasks_are_the_candidates() -> None:
    plan = planned()
    choice = task_choice.choose(
        plan, steered(plan, [WAYS, WAYS]), 2, Trials(3, None, 0)
    )
    assert (choice.place[:, [0, 1, 2]] == [0, 1, 0]).all()
    assert choice.place.max() == 1
    assert choice.trained[0].tolist() == [True, True, True, False]
    assert choice.recognised[0].tolist() == [True, True, True, False]
    assert (choice.interactions == 2 * 3 * 20).all()


def test_steps_after_the_end_of_an_episode_are_not_counted() -> None:
    changes = TaskChange("one"), TaskChange("other", hidden=1.0)
    scenario = make_scenario(ScenarioSpec("probe/two", "discount", changes, 1, 640))
    plan = planned(scenario)
    policies = steered(plan, [[[0.0], [1.0]]] * 2)
    for steps, length in ((None, 2), (1, 1)):
        choice = task_choice.choose(plan, policies, 2, Trials(3, steps, 0))
        assert (choice.interactions == 2 * 3 * length).all()
        assert not choice.place.any()  # both are equally good


def test_simulators_on_the_host_are_chosen_for_alike(monkeypatch) -> None:
    monkeypatch.setattr("rewire_jax.envs.vector_env._cores", lambda: 1)
    choices = []
    for environment in (walk.COMPILED, walk.walker()):
        scenario = walk.scenario(environment)
        quick = rewire_jax.preset(scenario, "sac_n", "quick")
        plan = prepare(dataclasses.replace(small(quick), envs=2), scenario)
        # The environment halves and inverts the second action.
        ways = [[[1.0, 0.0], [-1.0, -1.0]]] * plan.num_slots
        policies = steered(plan, ways)
        choices.append(task_choice.choose(plan, policies, 2, Trials(3, 5, 0)))
    for one, other in zip(*choices, strict=True):
        np.testing.assert_array_equal(one, other)
    assert choices[0].place.tolist() == [[0, 1]]
    assert (choices[0].interactions == 2 * 3 * 5).all()


@pytest.mark.parametrize(
    ("trials", "flag"),
    [
        (Trials(0, None, 0), "--trials"),
        (Trials(2**21, None, 0), "--trials"),
        (Trials(1, 0, 0), "--trial-steps"),
        (Trials(1, 21, 0), "--trial-steps"),
        (Trials(1.5, None, 0), "--trials"),  # type: ignore[arg-type]
        (Trials(1, True, 0), "--trial-steps"),
    ],
)
def test_bad_trials(trials: Trials, flag: str) -> None:
    plan = planned(method="ft1")
    with pytest.raises(UserError, match=f"{flag} "):
        task_choice.choose(plan, policies_of(plan), 1, trials)
