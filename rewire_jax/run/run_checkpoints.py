"""The checkpoints of a run.

`checkpoints/task-003` is never deleted. It contains policies and critics after three
finished tasks; everything else is reset at the start of a task. With `--boundaries
detected` it contains everything.
`checkpoints/task-003-step-0000200` contains everything in the middle of the next task;
only the newest of these is kept.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.core.settings_json import digest, from_json
from rewire_jax.methods import find_method
from rewire_jax.run.run_state import RunState, Segment, between
from rewire_jax.storage import checkpoint, run_folder
from rewire_jax.storage.json_lines import reading
from rewire_jax.training import population
from rewire_jax.training.population import Member
from rewire_jax.training.run_setup import Plan
from rewire_jax.training.sac import TrainState

_FOLDER = "checkpoints"


class OtherRunError(checkpoint.CheckpointError):
    """A checkpoint of another run."""


def identity(settings: Settings, members: Sequence[Member]) -> dict[str, Any]:
    """Identifies what a checkpoint belongs to: the settings and each member's own."""
    own = [[m.number, digest(m.seed, m.sac, m.options)] for m in members]
    return {"settings": digest(settings), "members": own}


def save(folder: Path, standing: RunState, plan: Plan) -> None:
    """Writes a checkpoint, and deletes older ones from the middle of a task."""
    items: dict[str, Any] = {
        "counts": {"active": standing.active, "selection": standing.selection}
    }
    name = _name(standing.stage, standing.steps)
    if standing.learner is not None:
        items |= _kept(standing.learner)
    if standing.state is not None:
        items |= {"state": standing.state}
    if standing.before is not None:
        items["before"] = standing.before
    metadata = {
        "stage": standing.stage,
        "steps": standing.steps,
        "items": sorted(items),
        "tables": run_folder.marks(folder),
        "identity": identity(plan.settings, plan.members),
    }
    if standing.segment:
        metadata["segment"] = standing.segment._asdict()
    checkpoint.save(folder / _FOLDER / name, items, metadata)
    checkpoints = checkpoint.available(folder / _FOLDER)
    checkpoint.remove(p for p in checkpoints if "-step-" in p.name and p.name != name)


def kept(folder: Path, stage: int | None) -> Path:
    """Returns the checkpoint after a stage, by default the latest stage.

    It may be damaged: an older one does not take its place.

    Raises:
      UserError: there is none.
    """
    between = sorted((folder / _FOLDER).glob("task-[0-9][0-9][0-9]"), reverse=True)
    if stage is not None:
        between = [path for path in between if path.name == _name(stage + 1)]
    if not between:
        which = (
            "finished no task" if stage is None else f"no checkpoint of task {stage}"
        )
        raise UserError(f"{folder} has {which} yet")
    return between[0]


def latest(folder: Path) -> int:
    """Returns the latest finished stage; raises `UserError` if there is none."""
    return int(kept(folder, None).name.removeprefix("task-")) - 1


def finished(folder: Path, stage: int) -> bool:
    """Whether the checkpoint after a stage exists."""
    return (folder / _FOLDER / _name(stage + 1)).exists()


def restore(folder: Path, plan: Plan, say: Callable[[str], None]) -> RunState | None:
    """Returns the newest state whose checkpoint and rows are complete, or None.

    Removes rows of the tables that were written after this checkpoint. If it is not the
    newest one, or there is none, or evaluations came after it, copies of the tables are
    kept: their rows may not be computed again as they were.

    Args:
      folder: folder of the run.
      plan: plan of the run.
      say: is told about every checkpoint that cannot be used, and about copies.

    Raises:
      UserError: `checkpoints` is a link or no folder; or none in it can be used, and
        one is of another run: nothing is overwritten then.
    """
    run_folder.check_own(folder / _FOLDER)
    found = sorted((folder / _FOLDER).glob("task-*"), reverse=True)
    foreign: OtherRunError | None = None
    for path in found:
        try:
            standing, marks = _load(path, plan)
        except checkpoint.CheckpointError as error:
            foreign = error if isinstance(error, OtherRunError) else foreign
            say(f"{error}; falling back to the one before")
            continue
        changed = run_folder.changed(folder, marks)
        if not changed:
            later = run_folder.longer(folder, marks)
            if path != found[0] or "results.jsonl" in later:
                _keep_copies(folder, marks, say)
            run_folder.cut(folder, marks)
            return standing
        say(
            f"{changed} has lost or foreign rows; falling back to the checkpoint "
            f"before {path.name}"
        )
    if foreign is not None:
        raise foreign
    _keep_copies(folder, {}, say)
    run_folder.cut(folder, {})
    return None


def _keep_copies(
    folder: Path, marks: Mapping[str, run_folder.Mark], say: Callable[[str], None]
) -> None:
    copies = run_folder.copies(folder, marks)
    if copies:
        names = ", ".join(copy.name for copy in copies)
        say(f"rows that are removed from the tables are kept in {names}")


def _load(path: Path, plan: Plan) -> tuple[RunState, dict[str, run_folder.Mark]]:
    program, members = plan.program, plan.stacked
    learner = jax.eval_shape(program.init, members)
    like: dict[str, Any] = {"counts": _counts(plan.num_slots)}
    metadata = _facts(path, identity(plan.settings, plan.members))
    saved = metadata["items"]
    if "state" in saved:
        task = jax.tree.map(lambda leaf: leaf[0], plan.tasks)
        like["state"] = program.state_shape(
            members, learner, like["counts"]["active"], 0, task
        )
    else:
        like |= _kept(learner)
    if "before" in saved and program.candidates is not None:
        candidates = jax.eval_shape(program.candidates, members, learner, 0)
        like["before"] = jax.ShapeDtypeStruct(candidates.valid.shape, jnp.float32)
    items, _ = checkpoint.load(path, like)
    if "policy" in items:
        return between(metadata["stage"], items, plan), metadata["tables"]
    items = population.place(items, plan.mesh)
    return RunState(
        stage=metadata["stage"],
        steps=metadata["steps"],
        learner=None,
        state=items["state"],
        before=items.get("before"),
        active=np.asarray(items["counts"]["active"]),
        selection=items["counts"]["selection"],
        segment=_segment(metadata),
    ), metadata["tables"]


def _segment(metadata: Mapping[str, Any]) -> Segment | None:
    if "segment" not in metadata:
        return None
    segment = Segment(**metadata["segment"])
    return segment._replace(scores=tuple(segment.scores))


def read_kept(folder: Path, stage: int, plan: Plan) -> dict[str, Any]:
    """What is kept after a stage: items `[members]` for `between`, on the host.

    Raises:
      CheckpointError: it is missing or damaged.
    """
    learner = jax.eval_shape(plan.program.init, plan.stacked)
    like = {"counts": _counts(plan.num_slots)} | _kept(learner)
    path = folder / _FOLDER / _name(stage + 1)
    _facts(path, identity(plan.settings, plan.members))
    return checkpoint.load(path, like)[0]


def read_policies(
    folder: Path, stage: int | None, like: Any, owner: Mapping[str, Any]
) -> tuple[Any, np.ndarray]:
    """The policies kept after a stage, or after the latest one.

    Args:
      folder: folder of the run.
      stage: of its sequence, or None.
      like: params and method_state, `[members]`, as shapes.
      owner: `identity` of the run.

    Returns:
      The same, on the host; and `[members]` bool, which have not diverged.

    Raises:
      UserError: there are none, or they are damaged.
    """
    path = kept(folder, stage)
    num_slots = len(jax.tree.leaves(like)[0])
    try:
        _facts(path, owner)
        wanted = {"policy": like, "counts": _counts(num_slots)}
        items, _ = checkpoint.load(path, wanted)
        return items["policy"], items["counts"]["active"]
    except OtherRunError:
        raise
    except checkpoint.CheckpointError as error:
        raise checkpoint.CheckpointError(
            f"{error}; delete it and newer checkpoints, and --resume trains that again"
        ) from error


def _facts(path: Path, owner: Mapping[str, Any]) -> dict[str, Any]:
    """What a checkpoint says of itself.

    Raises:
      CheckpointError: it is not that of a run, or of another run than the owner, or it
        is another than its name says.
    """
    facts = checkpoint.read_metadata(path)
    try:
        with reading(path):
            name = _name(facts["stage"], facts["steps"])
            list(facts["items"]), dict(facts["tables"])
    except UserError as error:
        raise checkpoint.CheckpointError(str(error)) from error
    if path.name != name:
        raise checkpoint.CheckpointError(f"checkpoint {path} was written as {name}")
    for part, own in owner.items():
        if facts.get("identity", {}).get(part) != own:
            raise OtherRunError(
                f"checkpoint {path} belongs to another run: it has other {part}; if "
                f"{run_folder.HEADER} has changed, restore it"
            )
    return facts


def _counts(num_slots: int) -> dict[str, Any]:
    return {
        "active": jax.ShapeDtypeStruct((num_slots,), bool),
        "selection": jax.ShapeDtypeStruct((num_slots,), jnp.int32),
    }


def _kept(learner: TrainState) -> dict[str, Any]:
    return {"policy": (learner.params, learner.method_state), "critic": learner.critic}


def _name(tasks: int, steps: int = 0) -> str:
    return f"task-{tasks:03d}" + (f"-step-{steps:07d}" if steps else "")


def saved(folder: Path, kind: str = "run") -> tuple[dict[str, Any], Settings]:
    """The header of a run or sweep, and the settings in it.

    Raises:
      UserError: there is none; or it is not as this version writes it, which says
        what version did.
    """
    header = run_folder.read_header(folder, kind)
    entry = find_method(header["settings"]["method"])
    with run_folder.telling_version(folder, header):
        settings = from_json(header["settings"], entry.settings)
    with reading(folder / run_folder.HEADER):
        tasks = header["tasks"]
        if len(tasks) != settings.tasks or not all(type(t) is str for t in tasks):
            raise ValueError(f"tasks are not {settings.tasks} names")
    return header, settings
