"""Whether a folder's header is still the one it was trained with."""

import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.methods import METHODS
from rewire_jax.run import run_checkpoints, sweep_members
from rewire_jax.storage import checkpoint, run_folder
from rewire_jax.storage.json_lines import reading
from rewire_jax.storage.sweep_results import each_batch
from rewire_jax.training import population
from rewire_jax.training.population import Member


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

    @functools.cache  # Read only if there is a checkpoint, and only once.
    def trained() -> tuple[Settings, Sequence[Member]]:
        _, settings = run_checkpoints.saved(folder, kind)
        if kind == "run":
            return settings, population.of_run(settings)
        return settings, sweep_members.members_of(folder, header, settings)

    for place, numbers in _parts(folder, header, kind):
        newest = checkpoint.newest_metadata(place / "checkpoints")
        found = newest.get("identity")
        if not found:
            continue
        settings, members = trained()
        if numbers is not None:
            members = [members[number] for number in numbers]
        if found != run_checkpoints.identity(settings, members):
            raise UserError(
                f"{folder / run_folder.HEADER} and the newest checkpoint in {place} do "
                "not belong together: restore the one that has changed"
            )


def _parts(
    folder: Path, header: Mapping[str, Any], kind: str
) -> Iterator[tuple[Path, list[int] | None]]:
    """The folders with checkpoints, and the members of a sweep's batch in each."""
    if kind == "run":
        yield folder, None
        return
    with reading(folder / run_folder.HEADER):
        count, tasks = len(header["members"]), len(header["tasks"])
    for _, place, numbers in each_batch(folder, count, tasks):
        yield place, numbers
