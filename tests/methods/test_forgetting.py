"""All methods on three tasks that conflict: what is learned, lost and traced."""

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

import rewire_jax
from rewire_jax.core.settings import Settings
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.scenarios import SCENARIOS, ScenarioSpec, make_scenario
from rewire_jax.methods import METHODS
from rewire_jax.nn import networks
from rewire_jax.reports import metrics
from rewire_jax.run import run_checkpoints
from rewire_jax.storage import checkpoint
from rewire_jax.training import run_setup
from tests.compiles import assert_once, compiles
from tests.each_method import each
from tests.tiny import PLAIN

# The goal is not observed. The last is opposite the first.
GOALS = {"northeast": (0.5, 0.5), "northwest": (-0.5, 0.5), "southwest": (-0.5, -0.5)}
CHANGES = tuple(TaskChange(name, extra={"goal": goal}) for name, goal in GOALS.items())
SPEC = ScenarioSpec("probe/corners", "reach", CHANGES, 1, 6400)
SCENARIO = make_scenario(SPEC)
SEEDS = 3
STATES = np.random.default_rng(0).uniform(-1, 1, (64, 2)).astype(np.float32)
PULLED = ("ft_l2", "ewc")
KEPT = ("packnet", "pnn", "sac_n", "ft_n", "csp", "cka")
QUICK = ("ft1", "rewire")  # half a minute each
# Where the quick profile's values do not fit networks and budgets this small.
OPTIONS: dict[str, dict] = {
    # At 1 the Fisher information of so few weights, so little trained, holds nothing.
    "ewc": {"coefficient": 100.0, "fisher_states": 64},
    # An eighth of such a network is too little for a task.
    "packnet": {"keep": 0.4},
    "pnn": {"width": 16},
    "csp": {"samples": 64, "estimations": 8},
    "clonex": {"states": 500},
    "reset_distill": {"states": 500, "distill_updates": 2_000, "distill_rate": 1e-3},
}


def settings(method: str) -> Settings:
    quick = rewire_jax.preset(SCENARIO, method, "quick")
    episodes = 64
    return dataclasses.replace(
        quick,
        seeds=SEEDS,
        envs=16,
        updates=4,
        warmup=320,
        eval_episodes=episodes,
        # CSP pays for its selection; the others' is one function with the evaluation.
        selection_episodes=2 if method == "csp" else episodes,
        report_every=6400,
        checkpoint_every=0,
        sac=dataclasses.replace(
            dataclasses.replace(quick.sac, **PLAIN),
            # A width of its own, so that no other test has compiled the same.
            hidden=32,
            depth=2,
            batch_size=64,
            lr_policy=1e-3,
            lr_critic=3e-3,
            lr_temperature=1e-3,
            discount=0.9,
            target_rate=0.02,
            time_limit="bootstrap",
        ),
        options=dataclasses.replace(quick.options, **OPTIONS.get(method, {})),
    )


class Trained(NamedTuple):
    """A run; `scores` `[seeds, 1 + stages, tasks]` begin with untrained policies."""

    folder: Path
    scores: np.ndarray
    compiled: Mapping[str, int]


def num_plays(method: str) -> int:
    """How many functions play: evaluation and selection may be one."""
    prepared = run_setup.prepare(settings(method), SCENARIO)
    options = prepared.settings
    sizes = {(len(GOALS), options.eval_episodes)}
    return len(sizes | {(prepared.budget.rows, options.selection_episodes)})


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Trained]:
    @functools.cache
    def run(method: str) -> Trained:
        with compiles() as counts:
            folder = rewire_jax.train(
                settings(method),
                tmp_path_factory.mktemp(method) / "run",
                scenario=SCENARIO,
            )
        return Trained(folder, read(folder), counts)

    return run


def read(folder: Path) -> np.ndarray:
    """See `Trained.scores`."""
    scores = np.full((SEEDS, 1 + len(GOALS), len(GOALS)), np.nan)
    for line in (folder / "results.jsonl").read_text().splitlines():
        row = json.loads(line)
        scores[row["seed"], row["stage"] + 1, row["task"]] = row["return"]
    return scores


def costs(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`[seeds, tasks]` before and after each task's own training, both positive."""
    return (
        -metrics.after_own_training(scores[:, :-1]),
        -metrics.after_own_training(scores[:, 1:]),
    )


def lost(scores: np.ndarray) -> np.ndarray:
    """`[seeds, tasks]`."""
    return -metrics.forgetting(scores[:, 1:])


@pytest.mark.parametrize("method", each(QUICK))
def test_tasks_are_learned(method: str, trained: Callable[[str], Trained]) -> None:
    before, after = costs(trained(method).scores)
    # What holds on to the first task is in the way of the others.
    learned = 1 if method in PULLED else len(GOALS)
    assert (after < before / 2)[:, :learned].all(), (before, after)


@pytest.mark.parametrize("method", each(QUICK))
def test_finetuning_forgets_and_the_others_lose_less(
    method: str, trained: Callable[[str], Trained]
) -> None:
    finetuned = lost(trained("ft1").scores)[:, 0]
    before, after = costs(trained("ft1").scores)
    # More than its training had gained.
    assert (finetuned > (before - after)[:, 0]).all()
    if method == "ft1":
        return
    lost_here = lost(trained(method).scores)
    assert (lost_here[:, 0] < 0.75 * finetuned).all(), (lost_here, finetuned)
    assert lost_here.mean() < 0.6 * lost(trained("ft1").scores).mean()
    if method in ("rewire", "clonex"):
        # Not by heads alone: rewire without alignment (beta 0) loses a third.
        assert lost_here.mean() < 0.1 * lost(trained("ft1").scores).mean()


@pytest.mark.slow
def test_cloning_keeps_what_rewire_without_alignment_loses(tmp_path: Path) -> None:
    plain = settings("rewire")
    losses = []
    for cloning in (0.0, 10.0):
        options = dataclasses.replace(
            plain.options, beta=0.0, cloning=cloning, cloning_states=500
        )
        folder = rewire_jax.train(
            dataclasses.replace(plain, options=options),
            tmp_path / str(cloning),
            scenario=SCENARIO,
        )
        losses.append(lost(read(folder)).mean())
    assert losses[1] < 0.1 * losses[0], losses


@pytest.mark.parametrize("method", each(QUICK, KEPT))
def test_what_is_kept_stays_bit_for_bit(
    method: str, trained: Callable[[str], Trained]
) -> None:
    folder = trained(method).folder
    observations = STATES
    for seed in range(SEEDS):
        load = functools.partial(rewire_jax.load_policy, folder, seed=seed)
        *now, latest = [load(task=t)(observations) for t in range(len(GOALS))]
        for task, actions in enumerate(now):
            then = load(task=task, stage=task)(observations)
            np.testing.assert_array_equal(actions, then)
            # Which says something, as the latest policy is another.
            assert np.abs(latest - actions).max() > 0.5


@pytest.mark.parametrize("method", each(QUICK))
def test_one_trace_for_all_tasks(
    method: str, trained: Callable[[str], Trained]
) -> None:
    counts = trained(method).compiled
    more = ["consolidate"] * (
        method in ("ewc", "packnet", "csp", "clonex", "reset_distill")
    )
    more += ["candidates"] * (method in ("rewire", "csp", "clonex"))
    more += ["after_baseline"] * (method == "clonex")
    # Only PackNet updates after its interactions.
    more += ["offline_update"] * (method == "packnet")
    assert_once(counts, *more)
    others = {"consolidate", "candidates", "after_baseline", "offline_update"}
    others -= set(more)
    assert not others & counts.keys()
    # Other methods may have played with these before.
    assert counts["episodes"] <= num_plays(method)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ft1", "rewire", "sac_n"])
def test_tasks_are_recognised_by_their_returns(
    method: str, trained: Callable[[str], Trained], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SCENARIOS, SPEC.name, SPEC)
    played = rewire_jax.evaluate(trained(method).folder, episodes=64, task_label="none")
    assert len(played) == SEEDS * len(GOALS)
    for row in played:
        chosen = row["chosen"]
        assert chosen["recognised"]
        assert chosen["return"] == row["return"]
        # Two trials each of three policies, then of two; FT-1 has only one policy.
        spent = 0 if method == "ft1" else (3 + 2) * 2 * 20
        assert chosen["interactions"] == spent


@pytest.mark.slow
def test_csp_plays_what_its_search_found(trained: Callable[[str], Trained]) -> None:
    prepared = run_setup.prepare(settings("csp"), SCENARIO)
    learner = jax.eval_shape(prepared.program.init, prepared.stacked)
    path = run_checkpoints.kept(trained("csp").folder, None)
    like = {"policy": (learner.params, learner.method_state)}
    _, state = checkpoint.load(path, like)[0]["policy"]
    for best, proposals in zip(state.best, state.proposals, strict=True):
        assert (best[-1] == proposals).all(axis=1).any()


@pytest.mark.slow
def test_what_was_learned_online_is_distilled(
    trained: Callable[[str], Trained],
) -> None:
    prepared = run_setup.prepare(settings("reset_distill"), SCENARIO)
    folder, observations = trained("reset_distill").folder, STATES
    learner = jax.eval_shape(prepared.program.init, prepared.stacked)
    like = {"policy": (learner.params, learner.method_state)}
    online = []
    for stage in range(len(GOALS)):
        path = run_checkpoints.kept(folder, stage)
        params, _ = checkpoint.load(path, like)[0]["policy"]
        for seed in range(SEEDS):
            first = jax.tree.map(lambda x, seed=seed: np.asarray(x)[seed], params)
            expert = np.tanh(networks.mlp_policy(first, observations)[0])
            load = functools.partial(rewire_jax.load_policy, folder, seed=seed)
            own = load(task=stage, stage=stage)(observations)
            assert np.abs(own - expert).mean() < 0.15
            online.append(expert)
    # Which says something, as policies of other tasks are far from it.
    assert np.abs(online[0] - online[-SEEDS]).mean() > 0.5


def short(method: str, seed: int, seeds: int):
    """A few updates in each of two tasks; learner, metrics and policies."""
    prepared = run_setup.prepare(
        dataclasses.replace(settings(method), seed=seed, seeds=seeds), SCENARIO
    )
    program, members = prepared.program, prepared.stacked
    learner, active = program.init(members), np.ones(seeds, bool)
    reports = []
    for index in range(2):
        task = SCENARIO.tasks[index].data
        state = program.begin(members, learner, active, index, task)
        state, report = program.chunk(members, state, index, task, 0, 24)
        reports.append(report)
        if program.consolidate:
            learner = program.consolidate(members, state, index, 24)
            state = state._replace(learner=learner)
        if prepared.budget.offline_steps:
            state = program.offline_update(members, state, index, 24, 0, 2)
        learner = program.finish(members, state.learner, index, None)
    return learner, reports, program.policies(members, learner)


@pytest.mark.slow  # each compiles anew for a member alone
@pytest.mark.parametrize("method", METHODS)
def test_a_member_is_the_same_alone(method: str) -> None:
    together, alone = short(method, 0, SEEDS), short(method, 1, 1)
    for whole, one in zip(
        jax.tree.leaves(together), jax.tree.leaves(alone), strict=True
    ):
        # Where cloning's loss is 0 but for rounding, Adam still takes steps.
        near = 1e-2 if method in ("clonex", "reset_distill") else 1e-4
        np.testing.assert_allclose(whole[1], one[0], rtol=1e-3, atol=near)
    others = [np.asarray(leaf) for leaf in jax.tree.leaves(together[0].params)]
    assert any(not np.allclose(leaf[0], leaf[1], atol=1e-3) for leaf in others)
