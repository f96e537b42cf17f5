"""Rewire with one mode against FT-L2 with a learned permutation."""

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import pytest

from rewire_jax.methods import METHODS, Entry
from rewire_jax.methods.base import Method
from rewire_jax.methods.regularization import FtL2Settings
from rewire_jax.methods.rewire import rewire
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.nn.networks import Linear
from rewire_jax.nn.permutation import permute
from rewire_jax.run import train_run
from tests.small_sweep import rows, run_sweep, small


class Permuted(NamedTuple):
    """A plain policy whose hidden layers' outputs are permuted."""

    hidden: tuple
    head: Linear
    scores: jax.Array


def permuted_l2(spec: Spec, options: FtL2Settings) -> Method:
    """FT-L2 with a learned permutation; of rewire it has the initial weights alone."""
    start = rewire(spec, RewireSettings(mode_slots=1, head_slots=spec.tasks))

    def init(key):
        params, _ = start.init(key)
        head = jax.tree.map(lambda leaf: leaf[0], params.heads)
        scores = jnp.tile(jnp.linspace(0, 1, spec.hidden), (spec.depth, 1))
        hidden = tuple(params.hidden)
        return Permuted(hidden, head, scores), (jnp.asarray(False), hidden)

    def start_task(key, params, memory, task):
        del key, task
        ranks = jnp.argsort(jnp.argsort(params.scores, axis=-1), axis=-1)
        return params._replace(scores=ranks / (spec.hidden - 1)), memory

    def distribution(params, memory, context, observation):
        del memory, context
        x = observation
        for layer, scores in zip(params.hidden, params.scores, strict=True):
            x = networks.activate(permute(networks.affine(layer, x), scores, 0.5))
        return networks.gaussian(networks.affine(params.head, x))

    def moved(params, memory):
        trained, previous = memory
        apart = jax.tree.map(
            lambda a, b: jnp.sum((a - b) ** 2), params.hidden, previous
        )
        return jnp.where(trained, sum(jax.tree.leaves(apart)), 0.0)

    def penalty(key, params, memory, context, observation, gaussian):
        del key, context, observation, gaussian
        return options.coefficient * moved(params, memory), {}

    def policy(params, memory, task):
        del memory, task
        return params

    return Method(
        init=init,
        start_task=start_task,
        distribution=distribution,
        penalty=penalty,
        inspect=lambda params, memory, _: {"alignment": moved(params, memory)},
        end_task=lambda params, memory, task, selection: (
            params,
            (jnp.asarray(True), params.hidden),
        ),
        policy=policy,
        act=lambda params, x: distribution(params, None, None, x),
        size=lambda params, memory: jnp.zeros((), int),
    )


@pytest.mark.slow
def test_one_mode_is_ft_l2_with_a_permutation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = Entry(permuted_l2, FtL2Settings, lambda *_: FtL2Settings())
    monkeypatch.setitem(METHODS, "permuted_l2", entry)
    shared = {"selection_episodes": 0, "seed": 5, "interactions": 640}
    options = RewireSettings(alignment="off", noise=0.0, tau=0.5, beta=0.3, alpha=1.0)
    sac = dataclasses.replace(small().sac, hidden=13, lr_policy=1e-2)
    settings = dataclasses.replace(small(**shared), options=options, sac=sac)
    swept = run_sweep(tmp_path / "sweep", settings, axes={"modes": [3, 1]})
    plain = dataclasses.replace(
        settings, method="permuted_l2", options=FtL2Settings(coefficient=0.3)
    )
    folder = train_run.train(plain, tmp_path / "plain")
    found = rows(swept, "training.jsonl")
    moved = 0
    for row in map(json.loads, (folder / "training.jsonl").read_text().splitlines()):
        modes, one = (
            found[row["stage"], member, row["interactions"]] for member in (0, 1)
        )
        for name, value in row.items():
            if name not in ("member", "return"):
                near_value = pytest.approx(value, rel=2e-3, abs=1e-5)
                assert one[name] == near_value, (name, row)
        assert one["distillation"] == 0
        moved += modes["q"] != pytest.approx(row["q"], rel=2e-3)
    # It is not only the environment that they have in common.
    assert moved > 8
    assert one["alignment"] > 0
