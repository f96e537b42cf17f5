import json

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import cached_actions
from experiments.cached_actions import Kept
from rewire_jax.run.campaign import campaign

TOML = """
title = "Two methods"
[[runs]]
scenarios = ["probe/reach"]
methods = ["ft1", "pnn"]
seeds = 1
profile = "quick"
[runs.settings]
tasks = 2
interactions = 640
warmup = 320
hidden = 8
eval_episodes = 1
"""


def test_change_is_relative_to_the_variance() -> None:
    rng = np.random.default_rng(0)
    before, other = rng.normal(size=(2, 4_000, 3)) * [1.0, 2.0, 0.5]
    assert cached_actions.change(jnp.asarray(before), jnp.asarray(before)) == 0
    expected = np.mean((other - before) ** 2) / np.mean(before.var(axis=0))
    found = cached_actions.change(jnp.asarray(before), jnp.asarray(other))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_allclose(found, 2, rtol=0.1)


@pytest.mark.slow
def test_a_frozen_column_acts_as_before_and_finetuning_does_not(tmp_path) -> None:
    file = tmp_path / "two.toml"
    file.write_text(TOML)
    campaign(file, tmp_path / "runs", workers=1)
    out = tmp_path / "changes"
    cached_actions.run(Kept(file=file, runs=tmp_path / "runs", out=out))
    rows = json.loads(out.with_suffix(".json").read_text())["rows"]
    changes = {row["method"]: row["change"] for row in rows}
    assert changes["pnn"] < 1e-10 < 1e-4 < changes["ft1"]
    assert out.with_suffix(".png").stat().st_size > 0
