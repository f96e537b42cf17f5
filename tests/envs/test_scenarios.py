import jax
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.envs import probe
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.domains import DOMAINS, DomainKind, register_domain
from rewire_jax.envs.scenarios import (
    SCENARIOS,
    ScenarioSpec,
    list_scenarios,
    make_scenario,
    register_scenario,
)

# The paper's table: the distinct part of each sequence, repeats, interactions.
PAPER = {
    "halfcheetah/forgetting": ("hugefoot moon carry_stuff rainfall", 2, 1e6),
    "halfcheetah/transfer": (
        "carry_stuff_hugegravity moon defective_module hugefoot_rainfall",
        2,
        1e6,
    ),
    "halfcheetah/robustness": (
        "normal inverted_actions normal inverted_actions",
        2,
        1e6,
    ),
    "halfcheetah/compositionality": (
        "tinyfoot moon carry_stuff_hugegravity tinyfoot_moon",
        2,
        1e6,
    ),
    "ant/forgetting": ("normal hugefoot rainfall moon", 2, 1e6),
    "ant/transfer": (
        "disabled_first_diagonal disabled_second_diagonal disabled_forefeet"
        " disabled_backfeet",
        2,
        1e6,
    ),
    "ant/robustness": ("normal inverted_actions normal inverted_actions", 2, 1e6),
    "ant/compositionality": (
        "disabled_hard1 disabled_hard2 disabled_forefeet disabled_backfeet",
        2,
        1e6,
    ),
    "humanoid/hard": ("normal moon carrystuff tinyfeet", 1, 2e6),
}

# gravity, friction, bodies, hidden of every change of the body or the world.
FEET = ("bfoot", "ffoot")
CHANGES = {
    "halfcheetah": {
        "carry_stuff": (1, 1, {"torso": 4}, 0),
        "carry_stuff_hugegravity": (1.5, 1, {"torso": 4}, 0),
        "defective_module": (1, 1, {}, 0.5),
        "hugefoot": (1, 1, dict.fromkeys(FEET, 1.5), 0),
        "tinyfoot": (1, 1, dict.fromkeys(FEET, 0.5), 0),
        "hugefoot_rainfall": (1, 0.4, dict.fromkeys(FEET, 1.5), 0),
        "moon": (0.15, 1, {}, 0),
        "tinyfoot_moon": (0.15, 1, dict.fromkeys(FEET, 0.5), 0),
        "rainfall": (1, 0.4, {}, 0),
    },
    "ant": {
        "hugefoot": (1, 1, {f"lower_leg_{i}": 1.5 for i in range(1, 5)}, 0),
        "moon": (0.7, 1, {}, 0),
        "rainfall": (1, 0.375, {}, 0),
    },
    "humanoid": {
        "moon": (0.15, 1, {}, 0),
        "carrystuff": (1, 1, {"torso": 4, "lwaist": 4}, 0),
        "tinyfeet": (1, 1, {"left_shin": 0.5, "right_shin": 0.5}, 0),
    },
}


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_scenarios(name):
    tasks, repeats, interactions = PAPER[name]
    scenario = make_scenario(name)
    names = [task.name for task in scenario.tasks]
    assert names == tasks.split() * repeats
    assert scenario.name == name
    assert scenario.domain == name.split("/")[0]
    assert scenario.backend == "v1"
    assert scenario.interactions == interactions
    assert scenario.distinct == len(set(names))
    first = list(dict.fromkeys(names))
    assert [task.distinct for task in scenario.tasks] == [first.index(n) for n in names]
    assert len({id(task.data) for task in scenario.tasks}) == scenario.distinct
    for task in scenario.tasks:
        assert isinstance(task.action_scale, np.ndarray)
        assert task.action_scale.shape == (scenario.environment.action_size,)
        assert task.observation_mask.shape == (scenario.environment.observation_size,)
    structures = {jax.tree.structure(task.data) for task in scenario.tasks}
    assert len(structures) == 1


def test_there_are_nine_and_the_probe():
    assert set(list_scenarios()) >= {*PAPER, "probe/reach"}
    assert list(list_scenarios()) == sorted(list_scenarios())


CONTINUAL_WORLD = {
    "t1": "push window-close hammer",
    "t2": "hammer window-close faucet-close",
    "t3": "window-close handle-press-side peg-unplug-side",
    "t4": "faucet-close shelf-place peg-unplug-side",
    "t5": "faucet-close shelf-place push-back",
    "t6": "stick-pull peg-unplug-side stick-pull",
    "t7": "stick-pull push-back push-wall",
    "t8": "push-wall shelf-place push-back",
    "cw10": "hammer push-wall faucet-close push-back stick-pull handle-press-side push"
    " shelf-place window-close peg-unplug-side",
}


@pytest.mark.parametrize("name", CONTINUAL_WORLD)
def test_continual_worlds_sequences(name):
    scenario = make_scenario(f"continual_world/{name}")
    names = CONTINUAL_WORLD[name].split()
    assert [task.name for task in scenario.tasks] == names
    assert (scenario.domain, scenario.backend) == ("metaworld", "mujoco")
    assert (scenario.reward, scenario.interactions) == ("v2", 1_000_000)
    distinct = list(dict.fromkeys(names))
    places = [int(task.data.physics) for task in scenario.tasks]
    assert places == [distinct.index(n) for n in names]
    assert scenario.environment.episode_length == 200
    for task in names:
        alone = make_scenario(f"continual_world/{task}")
        assert [task.name for task in alone.tasks] == [task]


def test_there_are_two_versions_of_rewards():
    scenario = make_scenario("continual_world/t6", reward="v1")
    assert scenario.reward == "v1"
    assert scenario.environment is not make_scenario("continual_world/t6").environment
    with pytest.raises(UserError, match="v3"):
        make_scenario("continual_world/t6", reward="v3")
    with pytest.raises(UserError, match="positional"):
        make_scenario("continual_world/t6", "positional")


def test_the_papers_changes():
    met = {domain: set() for domain in CHANGES}
    for name in PAPER:
        spec = SCENARIOS[name]
        for change in spec.changes:
            known = CHANGES[spec.domain].get(change.name, (1, 1, {}, 0))
            told = (change.gravity, change.friction, change.bodies, change.hidden)
            assert told == known, change.name
            acts = change.name == "inverted_actions" or "disabled" in change.name
            assert bool(change.actions) == acts, change.name
            met[spec.domain].add(change.name)
    for domain, changes in CHANGES.items():
        assert set(changes) <= met[domain]


def test_inverted_means_all_and_normal_means_nothing():
    for name in ("halfcheetah/robustness", "ant/robustness"):
        normal, inverted = make_scenario(name).tasks[:2]
        assert np.all(normal.action_scale == 1)
        assert np.all(inverted.action_scale == -1)


def test_defective_module_hides_half():
    task = make_scenario("halfcheetah/transfer").tasks[2]
    assert sorted(task.observation_mask) == [0.0] * 9 + [1.0] * 9


def test_scenarios_of_a_domain_share_its_environment():
    one, other = make_scenario("ant/transfer"), make_scenario("ant/forgetting")
    assert one.environment is other.environment
    spring = make_scenario("ant/transfer", "spring")
    assert spring.backend == "spring"
    assert spring.environment is not one.environment


def test_reach_has_four_goals_and_no_backend():
    scenario = make_scenario("probe/reach")
    assert scenario.backend == "probe"
    with pytest.raises(UserError, match="--backend"):
        make_scenario("probe/reach", "mjx")
    goals = {tuple(task.data.physics.tolist()) for task in scenario.tasks}
    assert len(goals) == len(scenario.tasks) == scenario.distinct == 4


def own(**changes):
    values = {
        "name": "own/one",
        "domain": "action",
        "changes": (TaskChange("plain"),),
        "repeats": 3,
        "interactions": 5,
    }
    return ScenarioSpec(**(values | changes))


def test_own_scenarios(monkeypatch):
    monkeypatch.setattr("rewire_jax.envs.scenarios.SCENARIOS", dict(SCENARIOS))
    assert len(make_scenario(own()).tasks) == 3  # even before it is known by name
    with pytest.raises(UserError, match="own/one"):
        make_scenario("own/one")
    register_scenario(own())
    register_scenario(own())
    assert "own/one" in list_scenarios()
    assert make_scenario("own/one").interactions == 5
    with pytest.raises(UserError, match="another"):
        register_scenario(own(repeats=1))
    with pytest.raises(UserError, match="another"):
        register_scenario(own(name="ant/transfer"))


def test_a_domain_of_ones_own(monkeypatch):
    domain = probe.make_domain("match")
    own_kind = DomainKind(lambda *_: probe.make_domain("reach"), "own")
    monkeypatch.setitem(DOMAINS, "mine", own_kind)  # and forgotten again
    register_domain("mine", domain)
    scenario = make_scenario(own(domain="mine"))
    assert scenario.environment is domain.environment
    assert scenario.backend == "own"
    with pytest.raises(UserError, match="--backend"):
        make_scenario(own(domain="mine"), backend="spring")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"domain": "walker"}, "halfcheetah"),
        ({"domain": "halfchetah"}, "Did you mean halfcheetah"),
        ({"changes": ()}, "at least one"),
        ({"repeats": 0}, "repeats"),
        ({"interactions": 0}, "interactions"),
        ({"changes": (TaskChange("a"), TaskChange("a", hidden=1.0))}, "one name"),
    ],
)
def test_specs_that_cannot_be(change, message):
    with pytest.raises(UserError, match=message):
        own(**change)


def test_a_misspelt_scenario_gets_a_hint():
    with pytest.raises(UserError, match=r"Did you mean .*ant/transfer.* Known: .*hard"):
        make_scenario("ant/tranfer")


def test_errors_are_one_line_and_reach_through():
    for spec, backend in (
        (own(domain="ant", changes=(TaskChange("x", bodies={"x": 2.0}),)), "spring"),
        ("ant/transfer", "fast"),
        ("nothing", "spring"),
    ):
        with pytest.raises(UserError) as error:
            make_scenario(spec, backend)
        assert "\n" not in str(error.value)
