"""Calls from Python with arguments of another kind than the function takes."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rewire_jax
from rewire_jax import ScenarioSpec, TaskChange, UserError
from rewire_jax.core.arguments import check_whole
from rewire_jax.envs.domains import DOMAINS
from rewire_jax.envs.scenarios import SCENARIOS
from rewire_jax.methods import METHODS
from tests.small_sweep import small
from tests.tiny import tiny

HERE = Path("none")
NORMAL = TaskChange("normal")
WRONG: list[tuple[str, Callable[[Any], Any]]] = [
    ("--task", lambda x: rewire_jax.load_policy(HERE, task=x)),
    ("--seed", lambda x: rewire_jax.load_policy(HERE, task=0, seed=x)),
    ("--stage", lambda x: rewire_jax.load_policy(HERE, task=0, stage=x)),
    ("--member", lambda x: rewire_jax.load_policy(HERE, task=0, member=x)),
    ("stage", lambda x: rewire_jax.load_policies(HERE, stage=x)),
    ("--stage", lambda x: rewire_jax.evaluate(HERE, stage=x)),
    ("--episodes", lambda x: rewire_jax.evaluate(HERE, episodes=x)),
    ("--seed", lambda x: rewire_jax.evaluate(HERE, seed=x)),
    ("--episode", lambda x: rewire_jax.render(HERE, task=0, episode=x)),
    ("--workers", lambda x: rewire_jax.campaign(HERE, workers=x)),
    ("--halving", lambda x: rewire_jax.sweep(small(), HERE, halving=x)),
    ("--random", lambda x: rewire_jax.sweep(small(), HERE, random=x)),
    ("repeats", lambda x: ScenarioSpec("own", "reach", (NORMAL,), x, 1)),
    ("interactions", lambda x: ScenarioSpec("own", "reach", (NORMAL,), 1, x)),
]
NAMES: list[tuple[str, Callable[[Any], Any]]] = [
    ("method", lambda x: rewire_jax.register_method(x, METHODS["ft1"])),
    ("domain", lambda x: rewire_jax.register_domain(x, reach())),
    ("scenario", lambda x: ScenarioSpec(x, "reach", (NORMAL,), 1, 1)),
    ("task", TaskChange),
]


def reach() -> Any:
    return DOMAINS["reach"].make("reach", (NORMAL,), "probe", "v2")


@pytest.mark.parametrize("value", [True, 1.5, "1", -1, 2**31, math.nan, [0], 1e9])
@pytest.mark.parametrize(("name", "call"), WRONG)
def test_numbers(name: str, call: Callable[[Any], Any], value: Any) -> None:
    with pytest.raises(UserError, match=f"{name} .*whole number"):
        call(value)
    assert not HERE.exists()


@pytest.mark.parametrize("value", [0, 3, np.int32(3), np.uint8(5)])
def test_whole_numbers_of_any_kind_are_taken(value: Any) -> None:
    check_whole("a number", value, 0, 5)


@pytest.mark.parametrize("value", ["", "  ", None, 1, "two\nlines", ["ft1"]])
@pytest.mark.parametrize(("name", "call"), NAMES)
def test_names(name: str, call: Callable[[Any], Any], value: Any) -> None:
    known = dict(METHODS), dict(DOMAINS), dict(SCENARIOS)
    with pytest.raises(UserError, match=name):
        call(value)
    assert known == (METHODS, DOMAINS, SCENARIOS)


@pytest.mark.parametrize("seconds", [-1, math.inf, math.nan, "10", True])
def test_times(seconds: Any) -> None:
    with pytest.raises(UserError, match="--seconds"):
        rewire_jax.render(HERE, task=0, seconds=seconds)
    with pytest.raises(UserError, match="--for"):
        rewire_jax.campaign(HERE, limit=seconds)


def test_only_what_is_made_for_it_is_registered() -> None:
    with pytest.raises(UserError, match="Entry"):
        rewire_jax.register_method("own", METHODS["ft1"].make)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="Domain"):
        rewire_jax.register_domain("own", "reach")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="another name"):
        rewire_jax.register_domain("ant", reach())
    assert "own" not in METHODS
    assert "own" not in DOMAINS


def test_what_a_scenario_does_not_have_is_refused() -> None:
    with pytest.raises(UserError, match="reward"):
        rewire_jax.make_scenario("probe/reach", reward="v9")
    with pytest.raises(UserError, match="--backend"):
        rewire_jax.make_scenario("probe/reach", backend="v1")
    rewire_jax.make_scenario("probe/reach", backend="probe", reward="v1")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seed": 2**31 - 1, "seeds": 2}, "--seed"),
        ({"eval_episodes": 2**21}, "--eval-episodes"),
        ({"selection_episodes": 2**30}, "--selection-episodes"),
        ({"reward": "v9"}, "reward"),
        ({"backend": "v1"}, "--backend"),
    ],
)
def test_settings(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=said):
        rewire_jax.train(dataclasses.replace(tiny(), **changes), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "call",
    [
        lambda: rewire_jax.make_train("settings"),
        lambda: rewire_jax.make_train(dataclasses.replace(tiny(), options=None)),
        lambda: rewire_jax.make_train(dataclasses.replace(tiny(), sac=None)),
        lambda: rewire_jax.sweep("settings", HERE, axes={"alpha": [1]}),
        lambda: rewire_jax.make_train(tiny(), "probe/reach"),
        lambda: rewire_jax.preset("probe/reach", "ft1"),
        lambda: rewire_jax.make_scenario(5),
        lambda: rewire_jax.register_scenario("probe/reach"),
        lambda: ScenarioSpec("own", "reach", ("a",), 1, 1),
        lambda: ScenarioSpec("own", "reach", (x for x in (NORMAL,)), 1, 1),
        lambda: ScenarioSpec("own", None, (NORMAL,), 1, 1),
        lambda: TaskChange("x", bodies=["foot"]),
        lambda: TaskChange("x", bodies={"foot": math.inf}, actions={"foot": 1.0}),
        lambda: TaskChange("x", gravity=True),
        lambda: rewire_jax.sweep(small(), HERE, axes={"alpha": "12"}),
        lambda: rewire_jax.sweep(small(), HERE, axes={"alpha": [True]}),
        lambda: rewire_jax.sweep(small(), HERE, axes={"alpha": 0.1}),
        lambda: rewire_jax.sweep(small(), HERE, axes={"alpha": [10**400]}),
        lambda: rewire_jax.sweep(small(), HERE, configurations=[{"alpha": "1"}]),
    ],
)
def test_what_is_of_another_class(call: Callable[[], Any]) -> None:
    with pytest.raises(UserError):
        call()
    assert not HERE.exists()
