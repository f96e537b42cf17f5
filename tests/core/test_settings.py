"""Values of settings that come from elsewhere than the command line."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings, validate
from rewire_jax.core.settings_json import from_json, to_json
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.training.run_setup import prepare
from tests.tiny import tiny


def changed(name: str, value: Any) -> Settings:
    settings = tiny()
    for field in ("sac", "options"):
        group = getattr(settings, field)
        if hasattr(group, name):
            value = dataclasses.replace(group, **{name: value})
            name = field
    return dataclasses.replace(settings, **{name: value})


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("envs", "16", "--envs must be a whole number, not '16'"),
        ("envs", 16.0, "--envs must be a whole number"),
        ("seeds", True, "--seeds must be a whole number, not True"),
        ("overlap", 1, "--overlap must be true or false, not 1"),
        ("method", ["rewire"], "--method must be a word"),
        ("discount", None, "--discount must be a number, not None"),
        ("time_limit", "never", "--time-limit must be one of terminal, bootstrap"),
        ("alignment", "all", "--alignment must be one of norm"),
        ("match_every", 2**31, "--match-every must be at most 2147483647"),
        ("modes", 1_001, "--modes must be at most 1000"),
        ("depth", 10**400, r"--depth must be at most 1000, not 10{79}$"),
        ("beta", 1e39, "--beta is too large for a 32-bit float"),
        ("beta", math.inf, "--beta must be finite"),
        ("discount", math.nan, "--discount must be finite"),
        ("tau", 1e-50, "--tau is too small for a 32-bit float"),
    ],
)
def test_a_value_of_another_kind_is_named(name: str, value: Any, says: str) -> None:
    with pytest.raises(UserError, match=says):
        validate(changed(name, value))
    saved = to_json(changed(name, value))
    with pytest.raises(UserError, match=says):
        from_json(saved, RewireSettings)


def test_no_neurons_of_a_residual_network_are_reset() -> None:
    settings = changed("network", "residual")
    validate(settings)
    sac = dataclasses.replace(settings.sac, redo_every=100)
    with pytest.raises(UserError, match="--redo-every"):
        validate(dataclasses.replace(settings, sac=sac))


def test_numbers_of_numpy_are_numbers() -> None:
    validate(changed("discount", np.float32(0.9)))
    validate(changed("envs", np.int64(16)))


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("method", "ft1", "--method ft1 takes FinetuneSettings .* not RewireSettings"),
        ("scenario", "ant/transfer", "--scenario ant/transfer: .* on probe/reach"),
        ("backend", "mjx", "--backend mjx: the run is on probe"),
    ],
)
def test_settings_that_contradict_each_other(name: str, value: str, says: str) -> None:
    scenario = prepare(tiny()).scenario
    with pytest.raises(UserError, match=says):
        prepare(dataclasses.replace(tiny(), **{name: value}), scenario)
