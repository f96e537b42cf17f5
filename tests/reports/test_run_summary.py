"""Summaries of runs that have the names of configurations."""

from pathlib import Path

from fake_run import write_run

from rewire_jax.reports.run_summary import summarize
from rewire_jax.storage.run_results import read_run


def test_the_papers_result_belongs_to_the_configuration_of_its_name(
    tmp_path: Path,
) -> None:
    runs = [
        read_run(write_run(tmp_path / name, method="ft_l2")) for name in ("one", "two")
    ]
    named = summarize(runs, names=["ft_l2, wide", "ft_l2"]).summaries
    assert [summary.label for summary in named] == ["ft_l2, wide", "FT-L2"]
    assert not any(named[0].published)
    assert all(named[1].published)
    assert not any(any(each.published) for each in summarize(runs).summaries)
