"""Whether runs had the same tasks under the same names."""

from collections.abc import Iterable
from typing import Any

from rewire_jax.core.errors import UserError
from rewire_jax.storage.result_files import known_changes
from rewire_jax.storage.run_results import RunData


def check_same_tasks(runs: Iterable[RunData]) -> None:
    """Raises `UserError` if tasks of one name differ from run to run."""
    known: dict[str, tuple[Any, RunData]] = {}
    for run in runs:
        for name, change in known_changes(run.header).items():
            first, other = known.setdefault(name, (change, run))
            if first != change:
                raise UserError(
                    f"cannot compare {run.folder} with {other.folder}: their tasks "
                    f"{name} have other values"
                )
