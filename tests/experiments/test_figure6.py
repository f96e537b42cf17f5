"""Figure 6: which configurations are trained, and what is made of them."""

import dataclasses
import itertools
import json

import pytest

import rewire_jax
from experiments import figure6_sensitivity
from experiments.figure6_sensitivity import Figure6
from rewire_jax.envs.scenarios import SCENARIOS
from rewire_jax.methods.rewire_settings import RewireSettings
from tests.fake_sweep import write_sweep

NAME = "halfcheetah/forgetting"
CENTRE = {"modes": 3, "alpha": 1e-5, "beta": 100.0}


@pytest.fixture
def swept(monkeypatch):
    """A scenario without physics, and sweeps that write numbers; what was called."""
    spec = dataclasses.replace(SCENARIOS["probe/reach"], name=NAME)
    monkeypatch.setitem(SCENARIOS, NAME, spec)
    calls = []

    def sweep(settings, folder, *, configurations, resume, **_):
        calls.append((folder, settings, configurations, resume))
        if not resume:
            write_sweep(folder, configurations=configurations, seeds=settings.seeds)
        return folder

    monkeypatch.setattr(rewire_jax, "sweep", sweep)
    return calls


def test_lines_have_the_others_at_the_preset_and_share_its_members():
    options = RewireSettings(**CENTRE)
    found = figure6_sensitivity.configurations(Figure6(), options)
    assert found[0] == CENTRE
    # Each once, and each differs from the preset in one value alone.
    assert len({tuple(each.values()) for each in found}) == len(found) == 10
    differences = [
        [(name, each[name]) for name in CENTRE if each[name] != CENTRE[name]]
        for each in found[1:]
    ]
    assert sorted(d for (d,) in differences) == sorted(
        (name, value)
        for name, values in (
            ("modes", (1, 2, 4)),
            ("alpha", (0.0, 1e-6, 1e-4)),
            ("beta", (0.1, 1.0, 10.0)),
        )
        for value in values
    )


def test_the_grid_has_every_combination():
    found = figure6_sensitivity.configurations(Figure6(full=True), None)
    assert [tuple(each.values()) for each in found] == list(
        itertools.product((1, 2, 3, 4), (0, 1e-6, 1e-5, 1e-4), (0.1, 1, 10, 100))
    )


def test_figure_is_made_from_one_sweep_that_is_resumed(swept, tmp_path, capsys):
    job = Figure6(seeds=2, interactions=20_000, tasks=2, out=tmp_path)
    figure6_sensitivity.run(job)
    ((folder, settings, found, resume),) = swept
    assert not resume
    assert (settings.tasks, settings.interactions, settings.seeds) == (2, 20_000, 2)
    assert found[0] == CENTRE
    out = tmp_path / "figure6-lines-halfcheetah-forgetting-quick-20000-tasks-2"
    assert (out / "panels.png").stat().st_size > 0
    made = json.loads((out / "sweep.json").read_text())
    assert [panel["axis"] for panel in made["panels"]] == list(CENTRE)
    assert made["title"] in capsys.readouterr().out
    figure6_sensitivity.run(job)
    assert swept[1][0] == folder
    assert swept[1][3]
    # The grid is another sweep.
    figure6_sensitivity.run(Figure6(seeds=1, full=True, out=tmp_path))
    assert len(swept[2][2]) == 64
    assert swept[2][0].name != folder.name
