"""The settings of each profile, for a scenario and a method."""

import dataclasses
from typing import Literal, get_args

from rewire_jax.core.arguments import require
from rewire_jax.core.settings import SacSettings, Settings
from rewire_jax.envs.scenarios import SCENARIOS, Scenario, check_scenario
from rewire_jax.methods import find_method

Profile = Literal["paper", "authors", "quick"]

# Scenario: learning rates of policy and critics, reward scale, delays of policy and
# target updates, target multiplier. Published with the authors' code.
_SAC = {
    "halfcheetah/forgetting": (1e-3, 3e-4, 1.0, 2, 2, 2.0),
    "halfcheetah/transfer": (3e-4, 3e-4, 1.0, 4, 2, 1.0),
    "halfcheetah/robustness": (1e-3, 1e-3, 1.0, 4, 2, 2.0),
    "halfcheetah/compositionality": (3e-4, 3e-4, 10.0, 4, 4, 2.0),
    "ant/forgetting": (1e-3, 1e-3, 10.0, 2, 4, 1.0),
    "ant/transfer": (1e-3, 1e-3, 1.0, 2, 2, 1.0),
    "ant/robustness": (1e-3, 1e-3, 1.0, 2, 4, 2.0),
    "ant/compositionality": (3e-4, 3e-4, 10.0, 4, 4, 2.0),
    "humanoid/hard": (1e-3, 3e-4, 0.1, 1, 1, 2.0),
}
_CONTINUAL_WORLD = SacSettings(
    lr_policy=1e-3,
    lr_critic=1e-3,
    lr_temperature=1e-3,
    target_multiplier=2.0,
    initial_temperature=2.7,
    batch_size=128,
    policy_delay=1,
    target_delay=1,
)


def _sac(scenario: Scenario) -> SacSettings:
    if _on_continual_world(scenario):
        return _CONTINUAL_WORLD
    if scenario.preset not in _SAC:
        return SacSettings()
    published = _SAC[scenario.preset]
    policy, critic, scale, policy_delay, target_delay, multiplier = published
    return SacSettings(
        lr_policy=policy,
        lr_critic=critic,
        reward_scale=scale,
        policy_delay=policy_delay,
        target_delay=target_delay,
        target_multiplier=multiplier,
    )


def _on_continual_world(scenario: Scenario) -> bool:
    """Whether Continual World's settings fit it."""
    return SCENARIOS.get(scenario.preset, scenario).domain == "metaworld"


def preset(scenario: Scenario, method: str, profile: str = "paper") -> Settings:
    """The settings of a profile.

    - "paper" has the published budgets, widths and coefficients. It departs from the
      paper only in the evaluation: 512 episodes of each task instead of 10 times as
      many, and 50 on Meta-World. The error of the mean stays far below the spread
      between seeds.
    - "authors" follows the authors' code where it differs from the text, also in the
      evaluation.
    - "quick" takes minutes on two cores: one round of the tasks, few interactions,
      narrower layers, and settings of SAC that learn faster, pink noise among them.

    Args:
      scenario: the scenario.
      method: name of a method.
      profile: "paper", "authors" or "quick".

    Raises:
      UserError: an unknown method or profile, or no `Scenario`.
    """
    check_scenario(scenario)
    profiles = get_args(Profile)
    require(
        profile in profiles,
        f"unknown profile {profile!r}: choose one of {', '.join(profiles)}",
    )
    order = [task.distinct for task in scenario.tasks]
    period = next(
        p
        for p in range(1, len(order) + 1)
        if all(task == order[i % p] for i, task in enumerate(order))
    )
    entry = find_method(method)
    base = Settings(
        scenario=scenario.name,
        method=method,
        profile=profile,
        backend=scenario.backend,
        reward=scenario.reward,
        tasks=len(scenario.tasks),
        interactions=scenario.interactions,
        paper_interactions=scenario.interactions,
        warmup=min(12_800, scenario.interactions // 4),
        sac=_sac(scenario),
        options=entry.preset(scenario.preset, period, profile),
        selection_episodes=entry.selection_episodes or 32,
    )
    if profile == "authors":
        sac = dataclasses.replace(
            base.sac, critic_entropy="batch_mean", policy_states="both"
        )
        base = dataclasses.replace(
            base,
            sac=sac,
            eval_episodes=5_120,
            selection_episodes=entry.selection_episodes or 1_280,
        )
    if _on_continual_world(scenario):
        return _continual_world(base)
    return _quick(base, period) if profile == "quick" else base


def _quick(base: Settings, tasks: int) -> Settings:
    """A profile of minutes on two cores.

    Its settings of SAC were chosen on the first task of halfcheetah/forgetting, with
    FT-1: docs/results.md, "Short training settings".
    """
    interactions = min(96_000, base.interactions)
    return dataclasses.replace(
        base,
        tasks=tasks,
        interactions=interactions,
        envs=32,
        updates=8,
        warmup=min(5_120, interactions // 4),
        eval_episodes=32,
        selection_episodes=min(base.selection_episodes, 4),
        report_every=3_200,
        checkpoint_every=32_000,
        sac=dataclasses.replace(
            base.sac,
            hidden=128,
            batch_size=128,
            lr_critic=1e-3,
            reward_scale=10.0,
            discount=0.97,
            target_rate=0.02,
            # From 2, at the paper's rate, the temperature would stay so high that the
            # policy is random for the whole profile.
            initial_temperature=0.1,
            critic_entropy="batch_mean",
            policy_states="both",
            noise_color=1.0,
        ),
    )


def _continual_world(base: Settings) -> Settings:
    """In all profiles: 1 environment; 50 steps, 50 updates; random steps at first."""
    start = min(1_000, base.interactions // 4)
    base = dataclasses.replace(
        base,
        envs=1,
        updates=50,
        update_every=50,
        warmup=start,
        random_interactions=start,
        buffer=1_000_000,
        eval_episodes=50,
        report_every=5_000,
        checkpoint_every=50_000,
    )
    if base.profile == "paper":
        return base
    if base.profile == "authors":
        played = min(base.selection_episodes, 10)
        return dataclasses.replace(base, eval_episodes=10, selection_episodes=played)
    return dataclasses.replace(
        base,
        interactions=min(30_000, base.interactions),
        eval_episodes=20,
        selection_episodes=1 if base.selection_episodes == 1 else 4,
        report_every=2_000,
        checkpoint_every=10_000,
        sac=dataclasses.replace(base.sac, hidden=128),
    )
