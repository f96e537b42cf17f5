from pathlib import Path

import pytest

from experiments import campaign_results, readme, suite
from experiments.campaign_results import Kept
from rewire_jax.core.errors import UserError
from rewire_jax.run.campaign_file import read_campaign
from rewire_jax.run.campaign_jobs import Job
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


def test_another_machine_goes_on_from_kept_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "RESULTS", tmp_path / "results")
    file = write_file(tmp_path / "made", "ft1", "rewire")
    jobs = write_runs(file)
    (jobs[0].folder / "checkpoints/task-002").rmdir()  # not finished
    campaign_results.run(Kept(file=file, runs=file.parent))
    kept = {path: path.read_bytes() for path in tmp_path.glob("results/**/*.tar.xz")}
    assert len(kept) == len(jobs) - 1
    new = tmp_path / "new"
    campaign_results.run(Kept(file=file, runs=new, restore=True))
    assert [Job(new, job.run).done for job in jobs] == [False] + [True] * 5
    for name in ("settings.json", "results.jsonl", "training.jsonl", "timing.jsonl"):
        there = new / jobs[1].run.name / name
        assert there.read_bytes() == (jobs[1].folder / name).read_bytes()
    assert {path: path.read_bytes() for path in kept} == kept


def test_restoring_leaves_a_run_that_is_there(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "RESULTS", tmp_path / "results")
    file = write_file(tmp_path / "made", "ft1")
    jobs = write_runs(file)
    campaign_results.run(Kept(file=file, runs=file.parent))
    table = jobs[0].folder / "results.jsonl"
    shorter = b"".join(table.read_bytes().splitlines(keepends=True)[:2])
    table.write_bytes(shorter)
    campaign_results.run(Kept(file=file, runs=file.parent, restore=True))
    assert table.read_bytes() == shorter


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
