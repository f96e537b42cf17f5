"""What a header says about tasks, and what happens if they change."""

import dataclasses
import json
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewire_jax
from rewire_jax import ScenarioSpec, TaskChange, UserError, make_scenario, write_report
from rewire_jax.envs.scenarios import Scenario, register_scenario
from rewire_jax.run.task_header import header_of_tasks
from tests.changed_header import changed
from tests.small_sweep import small


def spec(x: object = 0.8, hidden: float = 0.0) -> ScenarioSpec:
    changes = (
        TaskChange("near", extra={"goal": (0.1, 0.0)}, hidden=hidden),
        TaskChange("far", extra={"goal": (x, 0.8)}),
    )
    return ScenarioSpec("probe/ours", "reach", changes, 1, 640)


def reach(*values: Any, **more: Any) -> Scenario:
    return make_scenario(spec(*values, **more))


def train(folder: Path, scenario: Scenario, resume: bool = False) -> Path:
    settings = dataclasses.replace(small(seeds=1), scenario="probe/ours", tasks=2)
    return rewire_jax.train(settings, folder, scenario=scenario, resume=resume)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("trained") / "run", reach())


def test_other_values_under_the_same_names(trained: Path, tmp_path: Path) -> None:
    # However they are written.
    for same in (reach(np.float64(0.8)), reach(np.array(0.8))):
        train(trained, same, resume=True)
    for other in (reach(0.9), reach(0.8, hidden=0.5)):
        with pytest.raises(UserError, match="other tasks"):
            train(trained, other, resume=True)
    far = train(tmp_path / "far", reach(0.9))
    # Older versions did not write how tasks differ from their domain.
    older = changed(trained, tmp_path / "older", lambda header: header.pop("changes"))
    train(older, reach(0.9), resume=True)
    write_report([older, far], tmp_path / "report")
    for runs in ([trained, far], [older, trained, far]):
        with pytest.raises(UserError, match="far have other values"):
            write_report(runs, tmp_path / "report")


def test_evaluate_and_render_notice_it(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rewire_jax.envs.scenarios.SCENARIOS", {})
    register_scenario(spec(0.9))
    with pytest.raises(UserError, match="other tasks"):
        rewire_jax.evaluate(trained)
    with pytest.raises(UserError, match="other tasks"):
        rewire_jax.render(trained, task=0, out=tmp_path / "page.html")


def test_tasks_that_were_made_in_another_way(trained: Path, tmp_path: Path) -> None:
    scenario = reach()
    tasks = tuple(dataclasses.replace(t, change=None) for t in scenario.tasks)
    unknown = dataclasses.replace(scenario, tasks=tasks)
    train(trained, unknown, resume=True)
    run = train(tmp_path / "run", unknown)
    train(run, scenario, resume=True)
    write_report([trained, run], tmp_path / "report")


def test_a_damaged_header(trained: Path, tmp_path: Path) -> None:
    damages: tuple[Any, ...] = ([{}], 7)
    for number, damage in enumerate(damages):
        damaged = partial(dict.update, changes=damage)
        copy = changed(trained, tmp_path / str(number), damaged)
        with pytest.raises(UserError, match=r"settings\.json"):
            write_report([copy], tmp_path / "report")
        with pytest.raises(UserError, match=r"settings\.json"):
            train(copy, reach(), resume=True)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (np.longdouble(0.5), 0.5),
        (jnp.bfloat16(0.5), 0.5),
        (np.array([[1, 2]], np.int8), [[1, 2]]),
        (np.array([True]), [True]),
        (MappingProxyType({3: (1, None)}), {"3": [1, None]}),
        ({(0, 1): "x"}, {"(0, 1)": "x"}),
        (jax.random.key(3), "PRNGKeyArray"),
        (len, "builtin_function_or_method"),
    ],
)
def test_extra_values_of_any_kind(value: object, shown: object) -> None:
    scenario = reach()
    change = TaskChange("near", friction=2.0, extra={"of": value})
    task = dataclasses.replace(scenario.tasks[0], change=change)
    scenario = dataclasses.replace(scenario, tasks=(task,))
    header = header_of_tasks(scenario, 1)
    assert json.loads(json.dumps(header["changes"])) == [
        {"friction": 2.0, "extra": {"of": shown}}
    ]
