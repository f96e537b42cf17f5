"""Runs whose learner is not told when the task changes."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import rewire_jax
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.run import detecting_run, train_run
from rewire_jax.training import make_train
from tests import loops
from tests.stopped_run import assert_same_run, checkpoints, train_until
from tests.tiny import rows, tiny

CHUNKS = 30  # in a task


def settings(method: str = "ft_n", seed: int = 0, **changes) -> Settings:
    """Tasks of 30 chunks, each of one whole episode, with changes of the goal."""
    quick = tiny(method=method)
    return dataclasses.replace(
        quick,
        **{
            "seed": seed,
            "seeds": 1,
            "tasks": 2,
            "interactions": CHUNKS * 320,
            "report_every": 320,
            "checkpoint_every": 0,
            "eval_episodes": 32,
            "selection_episodes": 0,
            "boundaries": "detected",
        }
        | changes,
    )


def segments(folder: Path) -> list[list[int]]:
    """The segment after each chunk, by task."""
    training = rows(folder, "training.jsonl")
    tasks = sorted({row["stage"] for row in training})
    return [[r["segment"] for r in training if r["stage"] == t] for t in tasks]


def returns(folder: Path) -> np.ndarray:
    """`[stage, task]`, the first before any training."""
    results = rows(folder)
    stages = sorted({row["stage"] for row in results})
    return np.array([[r["return"] for r in results if r["stage"] == s] for s in stages])


@pytest.mark.parametrize("seed", range(3))
def test_a_change_is_noticed_and_the_policy_before_it_kept(
    seed: int, tmp_path: Path
) -> None:
    ours = train_run.train(settings(seed=seed), tmp_path / "ours")
    first, second = segments(ours)
    assert first == [0] * CHUNKS
    assert second == [1] * CHUNKS
    told = settings("ft1", seed, boundaries="given")
    theirs = train_run.train(told, tmp_path / "theirs")
    # One policy for both tasks loses the first one; both learn the second.
    ours, theirs = returns(ours), returns(theirs)
    assert ours[2, 0] > ours[1, 0] - 0.5 * (theirs[1, 0] - theirs[2, 0])
    assert ours[2, 0] > theirs[2, 0]
    assert ours[2, 1] > ours[0, 1]


def test_nothing_is_noticed_where_nothing_deviates_enough(tmp_path: Path) -> None:
    folder = train_run.train(settings(detection_threshold=1e9), tmp_path / "run")
    assert segments(folder) == [[0] * CHUNKS] * 2
    # FT-N then has a single policy, of size 1.
    assert {row["model_size"] for row in rows(folder)} == {1.0}
    deviations = [row["deviation"] for row in rows(folder, "training.jsonl")]
    assert max(d for d in deviations[:CHUNKS] if d is not None) < deviations[CHUNKS]


def test_there_are_at_most_two_segments_for_each_task(tmp_path: Path) -> None:
    """Each false alarm takes one; the last segment then stays."""
    few = settings(detection_threshold=0.0, interactions=60 * 320, tasks=1)
    folder = train_run.train(few, tmp_path / "run")
    found = segments(folder)[0]
    # The first 11 chunks fill the window, the next 9 the history.
    assert found == [0] * 20 + [1] * 40


def test_the_environments_are_told_and_the_learner_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The buffer runs on through the change; only what begins there is reset."""
    seen = []
    begin = detecting_run.DetectingRun.begin

    def watched(self, now, task):
        # A copy, because the function uses the state up.
        before = _copied(now.state) if now.segment else None
        after = begin(self, now, task)
        if before:
            seen.append((before, _copied(after.state), after.segment_time))
        return after

    monkeypatch.setattr(detecting_run.DetectingRun, "begin", watched)
    train_run.train(settings(), tmp_path / "run")
    ((before, after, time),) = seen
    assert time == CHUNKS * 320 // 16
    loops.equal(before.learner, after.learner)
    (old, _, _), (new, episodes, _) = before.collection, after.collection
    np.testing.assert_array_equal(before.collection.episodes.steps, 0)
    np.testing.assert_array_equal(old.reward, new.reward)
    row = time % old.reward.shape[1]
    others = np.arange(old.reward.shape[1]) != row
    np.testing.assert_array_equal(
        old.observation[:, others], new.observation[:, others]
    )
    np.testing.assert_array_equal(new.observation[:, row], episodes.state.observation)
    np.testing.assert_array_equal(episodes.start.observation, new.observation[:, row])
    assert not np.array_equal(old.observation[:, row], new.observation[:, row])


def _copied(tree: Any) -> Any:
    return jax.tree.map(np.array, tree)


# Stopped between the tasks, in the segment that goes on; and after the change.
@pytest.mark.parametrize(
    ("method", "chunks", "resumed"),
    [
        ("ft_n", CHUNKS + 1, "task-001"),
        ("rewire", CHUNKS + 25, "task-001-step-0000480"),
        pytest.param(
            *("packnet", CHUNKS + 25, "task-001-step-0000480"), marks=pytest.mark.slow
        ),
        pytest.param(
            *("ewc", CHUNKS + 25, "task-001-step-0000480"), marks=pytest.mark.slow
        ),
    ],
)
def test_a_resumed_run_is_the_same(
    method: str,
    chunks: int,
    resumed: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours = settings(method, checkpoint_every=3_840)
    whole = train_run.train(ours, tmp_path / "whole")
    assert segments(whole)[1] == [1] * CHUNKS
    train_until(monkeypatch, ours, tmp_path / "parts", chunks)
    assert checkpoints(tmp_path / "parts")[-1] == resumed
    parts = train_run.train(ours, tmp_path / "parts", resume=True)
    assert_same_run(parts, whole, ours)


def test_policies_are_loaded_and_evaluated_as_those_of_tasks(tmp_path: Path) -> None:
    ours = settings()
    folder = train_run.train(ours, tmp_path / "run")
    now = {r["task"]: r["return"] for r in rewire_jax.evaluate(folder, episodes=256)}
    final = returns(folder)[-1]
    assert [now[task] for task in range(2)] == pytest.approx(final, abs=2.0)
    policies = [rewire_jax.load_policy(folder, task=task) for task in range(2)]
    observation = np.zeros(2, np.float32)
    assert not np.array_equal(policies[0](observation), policies[1](observation))


def refused(text: str, function, *arguments) -> None:
    with pytest.raises(UserError, match=text) as error:
        function(*arguments)
    assert "\n" not in str(error.value)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    ours = settings()
    for text, method, changes in (
        ("--seeds 1", "ft_n", {"seeds": 2}),
        ("--selection-episodes 0", "rewire", {"selection_episodes": 2}),
        ("--report-every", "ft_n", {"report_every": 3_200}),
        ("--detection-threshold", "ft_n", {"detection_threshold": -1.0}),
        ("given, detected", "ft_n", {"boundaries": "guessed"}),
    ):
        refused(text, train_run.train, settings(method, **changes), tmp_path / "no")
    assert not (tmp_path / "no").exists()
    refused("use train", make_train.make_train, ours)
    with pytest.raises(UserError, match="rewire-jax train"):
        rewire_jax.sweep(ours, tmp_path / "no", axes={"lr_policy": [1e-3, 1e-4]})


def test_environments_on_the_host_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("metaworld")
    scenario = make_scenario("continual_world/t1")
    quick = rewire_jax.preset(scenario, "ft_n", "quick")
    quick = dataclasses.replace(quick, boundaries="detected")
    refused("another task of continual_world", train_run.train, quick, tmp_path / "no")
