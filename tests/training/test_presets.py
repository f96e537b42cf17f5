from dataclasses import replace

import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.envs.scenarios import SCENARIOS, make_scenario
from rewire_jax.methods import METHODS
from rewire_jax.training.presets import preset


def test_continual_worlds_loop_is_the_published_one():
    scenario = make_scenario("continual_world/t3")
    for method in METHODS:
        paper = preset(scenario, method)
        sac = paper.sac
        assert (paper.envs, paper.updates, paper.update_every) == (1, 50, 50)
        assert (paper.warmup, paper.random_interactions) == (1_000, 1_000)
        assert (paper.interactions, paper.buffer) == (1_000_000, 1_000_000)
        assert (sac.batch_size, sac.hidden, sac.depth) == (128, 256, 3)
        assert sac.lr_policy == sac.lr_critic == sac.lr_temperature == 1e-3
        assert (sac.policy_delay, sac.target_delay, sac.reward_scale) == (1, 1, 1)
        assert (sac.initial_temperature, sac.target_multiplier) == (2.7, 2)
        assert (paper.reward, paper.backend, paper.overlap) == ("v2", "mujoco", False)
    # A hundredth of FT-L2's, as on halfcheetah/forgetting.
    assert preset(scenario, "rewire").options.beta == 1e3
    assert preset(scenario, "ft_l2").options.coefficient == 1e5
    assert preset(scenario, "ewc").options.coefficient == 1e4
    # As many interactions of choosing as with 8 episodes of 1,000 steps, about.
    csp = preset(scenario, "csp")
    assert csp.options.rollouts * csp.selection_episodes * 200 == 6_400


def test_quick_is_the_paper_profile_with_less_of_it():
    scenario = make_scenario("continual_world/t6", reward="v1")
    quick, paper = (preset(scenario, "rewire", p) for p in ("quick", "paper"))
    assert quick.interactions < paper.interactions == quick.paper_interactions
    assert quick.sac.hidden < paper.sac.hidden
    assert (quick.updates, quick.update_every) == (50, 50)
    assert quick.tasks == paper.tasks == 3  # though stick-pull comes twice
    assert quick.options.head_slots == 2
    assert quick.reward == "v1"


@pytest.mark.parametrize("method", METHODS)
def test_authors_is_the_paper_profile_with_what_their_code_does(method):
    scenario = make_scenario("ant/forgetting")
    ours, theirs = (preset(scenario, method, p) for p in ("paper", "authors"))
    assert theirs.sac == replace(
        ours.sac, critic_entropy="batch_mean", policy_states="both"
    )
    assert theirs.eval_episodes == 512 * 10
    same = ("interactions", "envs", "updates", "warmup", "buffer", "tasks")
    assert all(getattr(ours, name) == getattr(theirs, name) for name in same)
    differing = {
        name: value
        for name, value in vars(theirs.options).items()
        if value != getattr(ours.options, name)
    }
    assert differing == {
        "rewire": {"mode_rate": "gradient", "select_first": False},
        "csp": {
            "estimations": 2048,
            "next_weights": "redrawn",
            "candidate_score": "since_reset",
        },
        "packnet": {"finetune_targets": "nested"},
    }.get(method, {})


def test_the_tuned_preset_is_the_same_everywhere():
    tuned = {
        replace(
            preset(make_scenario(name), "rewire_tuned", profile).options, head_slots=1
        )
        for name in SCENARIOS
        if not name.startswith("probe/")
        for profile in ("paper", "authors", "quick")
    }
    (options,) = tuned
    published = preset(make_scenario("halfcheetah/forgetting"), "rewire").options
    assert {n for n, v in vars(options).items() if v != vars(published)[n]} == {
        "alignment",
        "tau",
        "noise",
        "head_slots",
    }
    # The other settings are those of the profile, as for every method.
    for name in ("ant/forgetting", "halfcheetah/compositionality"):
        known, ours = (
            preset(make_scenario(name), method, "quick")
            for method in ("rewire", "rewire_tuned")
        )
        assert replace(ours, method="rewire", options=known.options) == known


def test_authors_on_continual_world():
    scenario = make_scenario("continual_world/t3")
    theirs = preset(scenario, "csp", "authors")
    assert theirs.interactions == 1_000_000
    assert theirs.sac.critic_entropy == "batch_mean"
    assert theirs.options.candidate_score == "episode"
    assert (theirs.eval_episodes, theirs.selection_episodes) == (10, 1)
    assert preset(scenario, "rewire", "authors").selection_episodes == 10


@pytest.mark.parametrize("method", METHODS)
def test_a_scenario_of_ones_own_has_the_settings_it_asks_for(method):
    known = SCENARIOS["halfcheetah/forgetting"]
    ours = replace(known, name="ours/forgetting", interactions=200_000)
    asking = replace(ours, preset=known.name)
    made, plain, published = (
        preset(make_scenario(spec, "positional"), method)
        for spec in (asking, ours, known)
    )
    assert (made.sac, made.options) == (published.sac, published.options)
    assert (made.scenario, made.interactions) == ("ours/forgetting", 200_000)
    assert plain.sac != published.sac


def test_an_unknown_preset_is_refused_by_name():
    with pytest.raises(UserError, match="halfcheetah/forgeting"):
        replace(SCENARIOS["ant/forgetting"], preset="halfcheetah/forgeting")
