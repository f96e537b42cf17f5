"""Whether a folder's header is still the one it was trained with."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rewire_jax.core.errors import UserError
from rewire_jax.methods import METHODS
from rewire_jax.run import run_state, sweep_members
from rewire_jax.storage import checkpoint, run_folder
from rewire_jax.storage.sweep_results import batch, batches_of, read_batches
from rewire_jax.training import population


def check_header(folder: Path) -> None:
    """Compares the header of a run or a sweep with the newest checkpoints.

    Without checkpoints, or if the method is not registered here, there is nothing to
    compare.

    Raises:
      UserError: the settings or the members are not those of the checkpoints.
    """
    kind = run_folder.kind(folder)
    if run_folder.read_header(folder, kind)["settings"]["method"] not in METHODS:
        return
    for place, numbers in _parts(folder, kind):
        found = _recorded(place)
        if not found:
            continue
        header, settings = run_state.saved(folder, kind)
        members = population.of_run(settings)
        if numbers is not None:
            every = sweep_members.members_of(folder, header, settings)
            members = tuple(every[number] for number in numbers)
        if found != run_state.identity(settings, members):
            raise UserError(
                f"{folder / run_folder.HEADER} has changed since the {kind} was "
                "trained: restore it"
            )


def _parts(folder: Path, kind: str) -> Iterator[tuple[Path, list[int] | None]]:
    """The folders with checkpoints, and which members of a sweep are in each."""
    if kind == "run":
        yield folder, None
        return
    for path in sorted(folder.glob("task-[0-9][0-9][0-9]/batches.json")):
        stage = int(path.parent.name[-3:])
        for number, members in enumerate(read_batches(batches_of(folder, stage))[0]):
            yield batch(folder, stage, number), members


def _recorded(folder: Path) -> dict[str, Any]:
    """The identity in the newest checkpoint that can be read, or nothing."""
    for path in checkpoint.available(folder / "checkpoints"):
        try:
            return checkpoint.read_metadata(path).get("identity", {})
        except UserError:  # damaged, or just replaced by a run that goes on
            continue
    return {}
