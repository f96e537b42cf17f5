import dataclasses
import itertools
import math

import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.methods import find_method
from rewire_jax.run import sweep_grid
from rewire_jax.training.population import cross
from tests.tiny import tiny

SETTINGS = tiny()


def test_a_grid_is_every_combination() -> None:
    made = sweep_grid.grid({"modes": [1, 2], "alpha": [0, 1e-5, 1e-4], "tau": [1]})
    expected = [(m, a, 1) for m in (1, 2) for a in (0, 1e-5, 1e-4)]
    assert [tuple(values.values()) for values in made] == expected
    assert all(list(values) == ["modes", "alpha", "tau"] for values in made)


RANGES = {"beta": [0.01, 100], "tau": [0.5, 2], "alpha": [0, 1e-3], "modes": [1, 4]}


def test_draws_fill_their_ranges() -> None:
    made = sweep_grid.draws(RANGES, 4000, SETTINGS)
    for name, (low, high) in RANGES.items():
        values = np.array([values[name] for values in made])
        assert low <= values.min()
        assert values.max() <= high
    beta, tau, alpha, modes = (
        np.array([values[name] for values in made]) for name in RANGES
    )
    # Half of a log-uniform draw lies below the geometric middle, of a uniform one below
    # the arithmetic middle; 4 standard errors of a share of 4000.
    near = 4 * math.sqrt(0.25 / 4000)
    for values, middle in ((beta, 1), (tau, 1.25), (alpha, 5e-4)):
        assert abs(np.mean(values < middle) - 0.5) < near
    assert abs(np.mean(beta < 0.1) - 0.25) < near
    assert {int(m) for m in modes} == {1, 2, 3, 4}
    assert all(abs(np.mean(modes == m) - 0.25) < near for m in (1, 4))
    # No two settings are drawn alike.
    shares = [(v - v.min()) / np.ptp(v) for v in (np.log(beta), tau, alpha)]
    for one, other in itertools.combinations(shares, 2):
        assert abs(np.corrcoef(one, other)[0, 1]) < 0.1


def test_one_value_is_kept() -> None:
    made = sweep_grid.draws({"beta": [3.0], "tau": [0.1, 1]}, 5, SETTINGS)
    assert {values["beta"] for values in made} == {3.0}
    assert len({values["tau"] for values in made}) == 5


def test_draws_follow_from_the_seed() -> None:
    other = dataclasses.replace(SETTINGS, seed=1)
    assert sweep_grid.draws(RANGES, 3, SETTINGS) == sweep_grid.draws(
        RANGES, 3, SETTINGS
    )
    assert sweep_grid.draws(RANGES, 3, SETTINGS) != sweep_grid.draws(RANGES, 3, other)
    # More draws begin with the same.
    assert sweep_grid.draws(RANGES, 5, SETTINGS)[:3] == sweep_grid.draws(
        RANGES, 3, SETTINGS
    )


def test_configure_sets_what_is_named_and_no_more() -> None:
    values = {"modes": 2.0, "lr_policy": 1e-4, "beta": 7.0}
    made = sweep_grid.configure(SETTINGS, values)
    assert (made.options.modes, type(made.options.modes)) == (2, int)
    assert made.sac == dataclasses.replace(SETTINGS.sac, lr_policy=1e-4)
    back = dataclasses.replace(made.options, modes=3, mode_slots=0, beta=1.0)
    assert back == SETTINGS.options
    member = cross([(made.sac, made.options)], [0])[0]
    assert {name: sweep_grid.read(member, name) for name in values} == values


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"hidden": 8}, "no sweep over 'hidden'"),
        ({"nonsense": 8}, "no sweep over 'nonsense'"),
        ({"dropout": 0.5}, "no sweep over 'dropout'"),
        ({"modes": 1.5}, "--modes must be a whole number"),
        ({"modes": 0}, "--modes must be at least 1"),
        ({"lr_policy": -1}, "--lr-policy must be above 0"),
        ({"tau": 0}, "--tau must be above 0"),
        ({"beta": math.nan}, "--beta"),
        ({"reward_scale": math.inf}, "--reward-scale"),
    ],
)
def test_what_makes_no_sense_is_said(values: dict, said: str) -> None:
    with pytest.raises(UserError, match=said):
        sweep_grid.configure(SETTINGS, values)


@pytest.mark.parametrize("values", [[], [1, 2, 3], [2, 1], [1, 1]])
def test_a_random_axis_needs_a_range(values: list) -> None:
    with pytest.raises(UserError, match="needs a range"):
        sweep_grid.draws({"beta": values}, 3, SETTINGS)


def test_members_of_one_population_have_places_for_all_their_modes() -> None:
    entry = find_method("rewire")
    options = [sweep_grid.configure(SETTINGS, {"modes": k}).options for k in (1, 4, 2)]
    together = entry.together(options)
    assert [(o.modes, o.mode_slots) for o in together] == [(1, 4), (4, 4), (2, 4)]
