"""The paper's figures are there for its scenarios and methods, and no others."""

import pytest

from rewire_jax.envs.scenarios import SCENARIOS, list_scenarios
from rewire_jax.methods import METHODS
from rewire_jax.reports import paper_results


def test_every_sequence_of_the_paper_has_every_method() -> None:
    # Scenarios of a single task are no sequences.
    tables = {
        name: paper_results.sources(name)
        for name in list_scenarios()
        if not name.startswith("probe/") and len(SCENARIOS[name].changes) > 1
    }
    assert len(tables) == 18
    for name, (table, *_) in tables.items():
        assert set(table.results) == set(paper_results.NAMES) <= set(METHODS)
        brax = not name.startswith("continual_world/")
        assert table.unit == ("÷ SAC-N" if brax else "success rate")
        if brax:
            assert table.results["sac_n"].mean == table.results["ft1"].size == 1


def test_only_v1_has_the_physics_of_the_paper() -> None:
    ours, other = (
        {source.made for source in paper_results.sources("halfcheetah/forgetting", on)}
        for on in ("v1", "positional")
    )
    assert all("another" in made for made in other)
    assert not any("another" in made for made in ours)


def test_scenarios_of_ones_own_have_none() -> None:
    for name in ("ant/limping", "probe/reach", "continual_world/hammer"):
        assert paper_results.sources(name) == ()


def test_abstract_of_the_paper() -> None:
    # "less than 60% of the parameters" of CSP on Ant and Humanoid.
    for scenario in ("ant/transfer", "humanoid/hard"):
        results = paper_results.sources(scenario)[0].results
        assert results["rewire"].size < 0.6 * results["csp"].size
        assert results["rewire"].mean == max(r.mean for r in results.values())


@pytest.mark.parametrize("scenario", ["continual_world/t5", "continual_world/cw10"])
def test_success_rates_of_the_paper(scenario: str) -> None:
    # "consistently achieves state-of-the-art performance" in both columns of Table 2.
    (table,) = paper_results.sources(scenario)
    assert table.results["rewire"].mean == max(r.mean for r in table.results.values())
    assert all(0 < rate.mean < 1 for rate in table.results.values())
    assert not table.sized
