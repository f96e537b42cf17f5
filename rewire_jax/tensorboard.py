"""TensorBoard events of a run, one log for each seed; nothing unless asked for."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from rewire_jax.errors import UserError

_PLACES = ("stage", "member", "seed", "interactions")


class Events:
    """Writes rows of the run's tables as scalars."""

    def __init__(self, folder: Path, seeds: Sequence[int], enabled: bool):
        """Opens `folder/tensorboard/seed-0` and so on.

        Raises:
          UserError: events are asked for and tensorboardX is not installed.
        """
        self._writers: dict[int, Any] = {}
        if not enabled:
            return
        try:
            from tensorboardX import SummaryWriter
        except ImportError as error:
            raise UserError(
                "--tensorboard needs tensorboardX: pip install rewire_jax[tensorboard]"
            ) from error
        for seed in seeds:
            log = folder / "tensorboard" / f"seed-{seed}"
            self._writers[seed] = SummaryWriter(str(log))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for writer in self._writers.values():
            writer.close()

    def training(self, row: Mapping[str, Any], interactions: int) -> None:
        """A row of training.jsonl; `interactions` a task."""
        if writer := self._writers.get(row["seed"]):
            step = row["stage"] * interactions + row["interactions"]
            for name, value in row.items():
                if name not in _PLACES and value is not None:
                    writer.add_scalar(f"training/{name}", value, step)

    def evaluation(self, row: Mapping[str, Any]) -> None:
        """A row of results.jsonl."""
        if (writer := self._writers.get(row["seed"])) and row["return"] is not None:
            name = f"evaluation/{row['task']:02d}-{row['name']}"
            writer.add_scalar(name, row["return"], row["interactions"]["training"])
