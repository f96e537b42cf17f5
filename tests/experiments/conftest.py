"""Experiments without training."""

import dataclasses

import pytest

import rewire_jax
from rewire_jax.envs.scenarios import SCENARIOS
from tests import fake_training


@pytest.fixture
def trained(monkeypatch):
    """Scenarios without physics, and training that writes numbers; what was called."""
    for name in fake_training.NAMES:
        spec = dataclasses.replace(SCENARIOS["probe/reach"], name=name)
        monkeypatch.setitem(SCENARIOS, name, spec)
    calls = []

    def train(settings, folder, **options):
        calls.append((folder, settings, options["resume"]))
        fake_training.train(settings, folder, **options)

    monkeypatch.setattr(rewire_jax, "train", train)
    return calls
