"""Whether a folder's header is still the one it was trained with."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

from rewire_jax.core.arguments import require
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.methods import METHODS
from rewire_jax.run import run_state, sweep_members
from rewire_jax.storage import checkpoint, run_folder
from rewire_jax.storage.json_lines import reading
from rewire_jax.storage.sweep_results import each_batch
from rewire_jax.training import population
from rewire_jax.training.population import Member
from rewire_jax.training.run_setup import Plan


def check_header(folder: Path) -> None:
    """Compares the header of a run or a sweep with the newest checkpoints.

    Without checkpoints, or if the method is not registered here, there is nothing to
    compare.

    Raises:
      UserError: the settings or the members are not those of the checkpoints.
    """
    kind = run_folder.kind(folder)
    header = run_folder.read_header(folder, kind)
    if header["settings"]["method"] not in METHODS:
        return
    if kind == "run":
        _compare(folder, folder, population.of_run)
        return
    with reading(folder / run_folder.HEADER):
        count, tasks = len(header["members"]), len(header["tasks"])

    @functools.cache
    def every() -> Sequence[Member]:
        _, settings = run_state.saved(folder, kind)
        return sweep_members.members_of(folder, header, settings)

    def members(numbers: Sequence[int], _: Settings) -> Sequence[Member]:
        return [every()[number] for number in numbers]

    for _, place, numbers in each_batch(folder, count, tasks):
        _compare(folder, place, functools.partial(members, numbers))


def check_tasks(folder: Path, plan: Plan, kind: str = "run") -> None:
    """Raises `UserError` if a folder's run or sweep had other tasks than the plan."""
    header = run_folder.read_header(folder, kind)
    length = plan.scenario.environment.episode_length
    same = header.get("tasks") == list(plan.names)
    require(
        same and header.get("episode_length") == length,
        f"{folder} was trained on other tasks than {plan.scenario.name} has now: name "
        "another --out, or restore the scenario",
    )


def _compare(
    folder: Path, place: Path, members: Callable[[Settings], Sequence[Member]]
) -> None:
    """Compares a header with the newest checkpoint in a folder that can be read.

    Args:
      folder: folder with the header.
      place: folder with the checkpoints.
      members: the members that trained there, by the header's settings.
    """
    for path in checkpoint.available(place / "checkpoints"):
        try:
            found = checkpoint.read_metadata(path).get("identity", {})
        except UserError:  # damaged, or just replaced by a run that goes on
            continue
        if found:
            _, settings = run_state.saved(folder, run_folder.kind(folder))
            if found != run_state.identity(settings, members(settings)):
                raise UserError(
                    f"{folder / run_folder.HEADER} and {path} do not belong together: "
                    "restore the one that has changed"
                )
        return
