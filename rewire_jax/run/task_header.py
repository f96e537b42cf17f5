"""What the header of a run or sweep says about its tasks."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rewire_jax.core.arguments import require
from rewire_jax.envs.base import TaskChange
from rewire_jax.training.run_setup import Plan


def header_of_tasks(plan: Plan) -> dict[str, Any]:
    """The part of the header that describes the tasks, JSON-ready."""
    tasks = plan.scenario.tasks[: len(plan.names)]
    return {
        "tasks": list(plan.names),
        "changes": [_values(task.change) for task in tasks],
        "episode_length": plan.scenario.environment.episode_length,
    }


def _values(change: TaskChange | None) -> dict[str, Any]:
    """The values of a change, JSON-ready, without its name and without defaults."""
    if change is None:
        return {}
    default = vars(TaskChange(change.name))
    changed = {k: v for k, v in vars(change).items() if v != default[k]}
    return json.loads(json.dumps(changed, skipkeys=True, default=_as_json))


def _as_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return value.tolist()
    return type(value).__name__  # `extra` may hold anything


def check_tasks(folder: Path, header: Mapping[str, Any], plan: Plan) -> None:
    """Raises `UserError` if a folder's run or sweep had other tasks than the plan.

    Args:
      folder: the folder.
      header: its header.
      plan: what is to be done with it.
    """
    now = header_of_tasks(plan)
    before = {"changes": now["changes"]} | dict(header)  # older headers have none
    require(
        all(before.get(name) == value for name, value in now.items()),
        f"{folder} was trained on other tasks than {plan.scenario.name} has now: name "
        "another --out, or restore the scenario",
    )
