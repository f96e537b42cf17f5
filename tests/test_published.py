"""The paper's figures are there for its scenarios and methods, and no others."""

from rewire_jax import published
from rewire_jax.methods import METHODS
from rewire_jax.scenarios import list_scenarios


def test_every_brax_scenario_has_every_method() -> None:
    scenarios = [name for name in list_scenarios() if not name.startswith("probe/")]
    for scenario in scenarios:
        table = published.sources(scenario)[0]
        assert set(table.results) == set(published.NAMES) <= set(METHODS)
        assert table.results["sac_n"].mean == table.results["ft1"].size == 1


def test_scenarios_of_ones_own_have_none() -> None:
    assert published.sources("ant/limping") == ()
    assert published.sources("probe/reach") == ()


def test_abstract_of_the_paper() -> None:
    # "less than 60% of the parameters" of CSP on Ant and Humanoid.
    for scenario in ("ant/transfer", "humanoid/hard"):
        results = published.sources(scenario)[0].results
        assert results["rewire"].size < 0.6 * results["csp"].size
        assert results["rewire"].mean == max(r.mean for r in results.values())
