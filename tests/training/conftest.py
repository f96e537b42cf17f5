import pytest


@pytest.fixture
def one_core(monkeypatch):
    """Simulators are made quickly where they share this process."""
    monkeypatch.setattr("rewire_jax.envs.vector_env._cores", lambda: 1)
