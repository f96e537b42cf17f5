"""Training that writes known numbers, for the tests of experiments."""

import dataclasses
import json
from pathlib import Path

import numpy as np

from rewire_jax.core.settings import Settings
from rewire_jax.core.settings_json import to_json
from rewire_jax.envs.scenarios import Scenario
from tests.fake_run import SCORES, write_cw, write_run

NAMES = ("halfcheetah/forgetting", "halfcheetah/transfer")
RATE = {
    ("rewire", "continual_world/t1"): 0.4,
    ("rewire", "continual_world/t3"): 0.8,
    ("rewire", "continual_world/cw10"): 0.5,
    ("ft1", "continual_world/t1"): 0.1,
    ("ft1", "continual_world/t3"): 0.3,
    ("ft1", "continual_world/cw10"): 0.0,
    ("ft1", "continual_world/window-close"): 0.5,
    ("ft1", "continual_world/handle-press-side"): 0.6,
    ("ft1", "continual_world/peg-unplug-side"): 0.7,
}
FACTORS = {("ft1", NAMES[0]): 0.5, ("ft1", NAMES[1]): 1.5}


def train(settings: Settings, folder: Path, *, scenario: Scenario, resume: bool):
    """Stands in for `rewire_jax.train`.

    In the second scenario, Rewire stops on the way, unless it resumes.
    """
    assert scenario.name == settings.scenario
    stop = settings.method == "rewire" and settings.scenario == NAMES[1]
    if resume:
        (folder / "settings.json").unlink()
        folder.rename(folder.with_suffix(".before"))
    options = settings.options.checked()
    facts = to_json(dataclasses.replace(settings, options=options))
    known = {name: facts[name] for name in ("method", "seeds", "seed", "profile")}
    if settings.scenario.startswith("continual_world/"):
        names = tuple(task.name for task in scenario.tasks[: settings.tasks])
        rate = RATE[settings.method, settings.scenario]
        shape = len(names) + 1, len(names)
        write_cw(
            folder,
            tasks=names,
            stages=len(names),
            scores=np.zeros(shape),
            rates=np.full(shape, rate),
            learning=np.full((len(names), 3), rate),
            **known,
        )
    else:
        write_run(
            folder,
            stages=2 if stop and not resume else 3,
            scores=SCORES * FACTORS.get((settings.method, settings.scenario), 1.0),
            **known,
        )
    head = json.loads((folder / "settings.json").read_text())
    head["settings"] |= facts
    (folder / "settings.json").write_text(json.dumps(head))
