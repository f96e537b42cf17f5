"""What the rows of a run say."""

import json

import numpy as np

from rewire_jax.run import run_state
from rewire_jax.run.loggers import Loggers
from rewire_jax.run.progress import Progress
from rewire_jax.run.recorder import Recorder
from rewire_jax.training.run_setup import prepare
from tests.tiny import tiny


def test_a_return_that_is_not_finite_is_marked(tmp_path):
    plan = prepare(tiny(method="ft1"))
    progress = Progress(plan.names, plan.interactions, ["seed 0", "seed 1"], "ft1")
    recorder = Recorder(plan, tmp_path, progress, Loggers((), (), print))
    returns = np.ones((2, len(plan.names)))
    returns[1, 2] = np.inf
    recorder.evaluation(run_state.start(plan), -1, {"return": returns})
    lines = (tmp_path / "results.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    lost = [(r["seed"], r["task"], r["return"]) for r in rows if r["diverged"]]
    assert lost == [(1, 2, None)]
