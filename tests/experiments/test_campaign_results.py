from pathlib import Path

import pytest

from experiments import campaign_results, readme, suite
from experiments.campaign_results import Kept
from rewire_jax.core.errors import UserError
from rewire_jax.run.campaign_file import read_campaign
from tests.reports.test_campaign_report import write_file, write_runs

ROOT = Path(__file__).resolve().parents[2]


def test_results_are_kept_so_that_a_page_can_show_them(tmp_path, monkeypatch):
    file = write_file(tmp_path / "made", "ft1", "rewire")
    write_runs(file)
    results = tmp_path / "results"
    monkeypatch.setattr(suite, "RESULTS", results)
    campaign_results.run(Kept(file=file, runs=file.parent))
    folder = results / "campaign-campaign"
    assert (folder / "returns.csv").read_bytes() == (
        file.parent / "returns.csv"
    ).read_bytes()
    page = readme.fill(
        "<!-- results: campaign-campaign | method | performance -->\n<!-- end -->",
        results=results,
    )
    # The mean of the last row of SCORES, and 200 more for each further seed.
    assert "| FT-1 | 750 ± 200 |" in page
    text = (folder / "report.md").read_text()
    # Rewire's scores are higher in every pair of seeds.
    row = next(x for x in text.splitlines() if x.startswith("| Ours") and "1.00" in x)
    assert "–" in row


def test_nothing_is_kept_of_a_campaign_without_results(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "RESULTS", tmp_path / "results")
    file = write_file(tmp_path / "made", "ft1")
    with pytest.raises(UserError):
        campaign_results.run(Kept(file=file, runs=file.parent))
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    "file", sorted((ROOT / "experiments/campaigns").glob("*.toml"))
)
def test_the_committed_campaigns_can_be_read(file):
    made = read_campaign(file)
    assert made.tuned_on is not None
