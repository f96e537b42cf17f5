"""The setting `network`, in all methods."""

import dataclasses
import json
import typing
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import rewire_jax
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Network
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.methods import METHODS, find_method, wiring
from rewire_jax.methods.base import Method
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.training.acting import act_function
from rewire_jax.training.run_setup import prepare
from tests.each_method import each
from tests.tiny import tiny

SPEC = Spec(observations=3, actions=2, hidden=8, depth=2, tasks=3)
KEY = jax.random.key(0)
OBSERVATION = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
NETWORKS = typing.get_args(Network)


def make(name: str, network: str) -> Method:
    quick = rewire_jax.preset(make_scenario("probe/reach"), name, "quick")
    spec = SPEC._replace(network=network)
    options = quick.options.checked()
    if isinstance(options, RewireSettings) and network == "residual":
        options = dataclasses.replace(options, alignment="off")
    return find_method(name).make(spec, options)


def played(method: Method, params: Any, state: Any) -> Any:
    """Mean and log-std as in an acting step of training."""
    extras = method.extras(KEY, state, None, np.zeros(len(OBSERVATION), int))
    context = method.context(KEY, state, "act", extras)
    return method.distribution(params, state, context, OBSERVATION)


def test_every_network_has_an_activation() -> None:
    assert tuple(networks.ACTIVATIONS) == NETWORKS


@pytest.mark.parametrize("name", METHODS)
def test_training_and_evaluation_have_the_network(name: str) -> None:
    outputs = []
    for network in NETWORKS:
        method = make(name, network)
        params, state = method.init(KEY)
        in_training = played(method, params, state)
        alone = method.act(method.policy(params, state, np.asarray(0)), OBSERVATION)
        np.testing.assert_allclose(in_training, alone, rtol=1e-5, atol=1e-5)
        outputs.append(np.asarray(alone))
    assert np.abs(outputs[0] - outputs[1]).max() > 0.01


@pytest.mark.parametrize("name", METHODS)
def test_evaluations_share_what_is_compiled(name: str) -> None:
    acts = {network: make(name, network).act for network in NETWORKS}
    for network, act in acts.items():
        assert make(name, network).act is act
    assert len(set(acts.values())) == len(NETWORKS)


def test_rewire_aligns_no_residual_network() -> None:
    settings = tiny()
    sac = dataclasses.replace(settings.sac, network="residual")
    with pytest.raises(UserError, match="--alignment off"):
        prepare(dataclasses.replace(settings, sac=sac))
    options = dataclasses.replace(settings.options, alignment="off")
    prepare(dataclasses.replace(settings, sac=sac, options=options))


@pytest.mark.parametrize("network", ["layer_norm", "residual"])
def test_a_wired_network_is_a_plain_one(network: str) -> None:
    method = make("rewire", network)
    params, state = method.init(KEY)
    scores = jax.random.uniform(KEY, params.scores.shape)
    context = method.context(KEY, state, "act", ())
    got = method.distribution(
        params._replace(scores=scores), state, context, OBSERVATION
    )
    orders = np.argsort(scores[context.mode], axis=-1)
    head = jax.tree.map(lambda x: x[0], params.heads)
    plain = [*wiring.fold(params.hidden, orders), head]
    np.testing.assert_allclose(got, method.act(plain, OBSERVATION), atol=1e-5)
    others = [*wiring.fold(params.hidden, orders[:, ::-1]), head]
    assert not np.allclose(got, method.act(others, OBSERVATION), atol=1e-3)


@pytest.mark.parametrize("name", each(("ft1",)))
def test_a_run_trains_the_network(name: str, tmp_path: Path) -> None:
    settings = tiny(method=name)
    # Of CSP's candidates every step counts.
    interactions = 3_200 if name == "csp" else 640
    settings = dataclasses.replace(
        settings,
        seeds=1,
        tasks=2,
        interactions=interactions,
        sac=dataclasses.replace(settings.sac, network="layer_norm"),
    )
    folder = rewire_jax.train(settings, tmp_path / "run")
    rows = (folder / "results.jsonl").read_text().splitlines()
    results = [json.loads(row) for row in rows]
    assert len(results) == (1 + 2) * 2  # untrained, then after each task
    assert not any(row["diverged"] for row in results)
    assert all(np.isfinite(row["return"]) for row in results)

    header = json.loads((folder / "settings.json").read_text())
    spec = Spec(**header["spec"])
    assert spec.network == header["settings"]["sac"]["network"] == "layer_norm"
    policies = rewire_jax.load_policies(folder)
    learned = policies.member(0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(learned))
    plain = find_method(name).make(
        spec._replace(network="mlp"), settings.options.checked()
    )
    observation = OBSERVATION[:, : spec.observations]
    for task in range(2):
        actions = policies.act(learned, task, observation)
        other = act_function(plain, spec)(learned, task, observation)
        assert np.abs(actions - other).max() > 0.01
