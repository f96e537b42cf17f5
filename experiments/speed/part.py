"""What a part of the bench is, and how much of it is measured."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from matplotlib.axes import Axes

from experiments.suite import Columns, Row
from rewire_jax.core.settings import Settings
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.training.presets import preset


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
      rounds: how often each loop is timed.
      seconds: about how long each time.
      quick: everything tiny, to see that it runs.
    """

    rounds: int = 12
    seconds: float = 0.5
    quick: bool = False

    @property
    def scenario(self) -> str:
        """What is learned."""
        return "probe/reach" if self.quick else "halfcheetah/forgetting"

    def settings(self, method: str, **sac: Any) -> Settings:
        """The paper's settings of a method, some of SAC's replaced."""
        settings = preset(make_scenario(self.scenario), method)
        if self.quick:
            sac = {"hidden": 16, "depth": 1, "batch_size": 16} | sac
            settings = replace(settings, envs=2, updates=2, interactions=256, warmup=2)
        return replace(settings, sac=replace(settings.sac, **sac))


def on_probe(settings: Settings) -> Settings:
    """The same on a probe, whose own steps cost next to nothing."""
    probe = make_scenario("probe/reach")
    return replace(settings, scenario=probe.name, backend=probe.backend, tasks=2)


class Part(NamedTuple):
    """A part: how it is measured and shown.

    Attributes:
      title: above the table.
      reading: below it, how to read it.
      measure: gives the rows, ready for JSON.
      columns: heading -> what a row shows there.
      picture: title of the picture, and what draws it; None where there is none.
    """

    title: str
    reading: str
    measure: Callable[[Effort], list[Row]]
    columns: Columns
    picture: tuple[str, Callable[[Axes, list[Row]], None]] | None = None
