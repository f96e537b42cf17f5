"""What a sweep's folder says of its members, and where they are."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.core.settings_json import to_json
from rewire_jax.run import run_checkpoints, task_header
from rewire_jax.run.sweep_grid import describe, make_members, values_of
from rewire_jax.storage import run_folder
from rewire_jax.storage.json_lines import reading
from rewire_jax.storage.sweep_results import batch, batches_of, read_batches
from rewire_jax.training.population import Member
from rewire_jax.training.run_setup import Plan


class Found(NamedTuple):
    """Where a member's policies are.

    Attributes:
      folder: of the checkpoints.
      stage: the task after which; None for the latest.
      place: of the member among those that were trained together.
      num_slots: of these.
      members: numbers of those in a batch of a sweep.
    """

    folder: Path
    stage: int | None
    place: int
    num_slots: int
    members: tuple[int, ...]


def find(folder: Path, member: int, stage: int | None) -> Found:
    """Where a member is after a stage, or after the latest one.

    Raises:
      UserError: it has not been trained so far.
    """
    begun = folder.glob("task-[0-9][0-9][0-9]/batches.json")
    stages = sorted(int(path.parent.name[-3:]) for path in begun)
    for each in reversed(stages) if stage is None else {stage}.intersection(stages):
        batches, num_slots = read_batches(batches_of(folder, each))
        for number, members in enumerate(batches):
            inside = batch(folder, each, number)
            if member in members and run_checkpoints.finished(inside, each):
                place = members.index(member)
                return Found(inside, each, place, num_slots, tuple(members))
    when = "any task" if stage is None else f"task {stage}"
    raise UserError(f"{folder}: member {member} has not been trained on {when} yet")


def make_header(
    plan: Plan,
    members: Sequence[Member],
    names: Sequence[str],
    axes: Mapping[str, Any],
    **asked: int,
) -> dict[str, Any]:
    """Returns the contents of the sweep's settings.json.

    Args:
      plan: plan of any member.
      members: all members.
      names: names of the settings in which members differ.
      axes: names and values of the axes as given; if empty, the members' values.
      asked: other arguments of the sweep.
    """
    told = describe(members, names, plan.settings.seeds)
    return {
        "kind": "sweep",
        "settings": to_json(plan.settings),
        "axes": axes or values_of(told),
        **asked,
        "members": told,
        **task_header.header_of_tasks(plan.scenario, len(plan.names)),
        "spec": plan.spec._asdict(),
        "provenance": run_folder.provenance(),
    }


def members_of(
    folder: Path, header: Mapping[str, Any], settings: Settings
) -> tuple[Member, ...]:
    """The members of a sweep, from its header.

    Raises:
      UserError: what the header says of the members does not fit together.
    """
    with reading(folder / run_folder.HEADER):
        rows = list(header["members"])
        values = [dict(row["values"]) for row in rows[:: settings.seeds]]
        _, members = make_members(settings, values)
        if describe(members, tuple(values[0]), settings.seeds) != rows:
            raise ValueError("its members are not those of its configurations")
    return members
