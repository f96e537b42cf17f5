"""What the header of a run or sweep says about its tasks."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.arguments import require
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.scenarios import Scenario
from rewire_jax.storage import run_folder
from rewire_jax.storage.json_lines import reading
from rewire_jax.storage.result_files import known_changes


def header_of_tasks(scenario: Scenario, count: int) -> dict[str, Any]:
    """The part of the header that describes the first tasks, JSON-ready."""
    tasks = scenario.tasks[:count]
    return {
        "tasks": [task.name for task in tasks],
        "changes": [_values(task.change) for task in tasks],
        "episode_length": scenario.environment.episode_length,
    }


def _values(change: TaskChange | None) -> dict[str, Any] | None:
    """The values of a change without its name and without defaults; None if unknown."""
    if change is None:
        return None
    default = vars(TaskChange(change.name))
    return {k: _data(v) for k, v in vars(change).items() if v != default[k]}


def _data(value: Any) -> Any:
    """As JSON has it; `extra` may hold anything, and what is no data is its type."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        return {str(key): _data(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_data(each) for each in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        if jnp.issubdtype(value.dtype, np.floating):
            return np.asarray(value, float).tolist()
        if jnp.issubdtype(value.dtype, np.integer) or value.dtype == bool:
            return np.asarray(value).tolist()
    return type(value).__name__


def check_tasks(
    folder: Path, header: Mapping[str, Any], scenario: Scenario, count: int
) -> None:
    """Raises `UserError` if a folder's run or sweep had other tasks.

    Args:
      folder: the folder.
      header: its header.
      scenario: what it is to go on with, or to be played in.
      count: number of its tasks.
    """
    now = header_of_tasks(scenario, count)
    with reading(folder / run_folder.HEADER):
        before, after = known_changes(header), known_changes(now)
    require(
        all(header.get(name) == now[name] for name in ("tasks", "episode_length"))
        and all(before.get(name, change) == change for name, change in after.items()),
        f"{folder} was trained on other tasks than {scenario.name} has now: name "
        "another --out, or restore the scenario",
    )
