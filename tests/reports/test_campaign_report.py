"""The report of a campaign, from run folders with known numbers."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from fake_run import rows, write_run

from rewire_jax.core.errors import UserError
from rewire_jax.core.settings_json import to_json
from rewire_jax.reports.campaign_report import CampaignReport, write_campaign_report
from rewire_jax.reports.statistics import (
    normalised_iqm,
    probability_of_improvement,
    stratified_bootstrap,
)
from rewire_jax.run.campaign_file import as_populations, read_campaign
from rewire_jax.run.campaign_jobs import Job

TASKS = ("near", "far")
# Before training, after task 0, after task 1; each seed scores 200 more than the last.
SCORES = {
    "ft1": np.array([[1, 2], [900, 10], [300, 800]]),
    "rewire": np.array([[1, 2], [5000, 20], [6000, 7000]]),
    "sac_n": np.array([[1, 2], [900, 30], [300, 800]]),
}
TEXT = """
title = "Two methods"
tuned_on = ["probe/reach"]
population = "{population}"
[[runs]]
scenarios = ["probe/reach"]
methods = {methods}
seeds = 3
profile = "quick"
[runs.settings]
tasks = 2
"""


def write_file(folder: Path, *methods: str, text: str = TEXT, population="never"):
    """The file of a campaign."""
    folder.mkdir(exist_ok=True)
    path = folder / "campaign.toml"
    path.write_text(
        text.replace("{methods}", json.dumps(methods)).replace(
            "{population}", population
        )
    )
    return path


def write_runs(file: Path, population: bool = False, stages: int = 2) -> list[Job]:
    """The run folders of a campaign, in the folder of its file."""
    runs = read_campaign(file).runs
    jobs = [Job(file.parent, r) for r in (as_populations(runs) if population else runs)]
    for job in jobs:
        settings = job.run.settings
        write_run(
            job.folder,
            seed=settings.seed,
            seeds=settings.seeds,
            stages=stages,
            tasks=TASKS,
            scores=SCORES[settings.method],
        )
        path = job.folder / "settings.json"
        head = json.loads(path.read_text())
        path.write_text(json.dumps(head | {"settings": to_json(settings)}))
        if stages == 2:
            (job.folder / "checkpoints/task-002").mkdir(parents=True)
    return jobs


def report(file: Path) -> CampaignReport:
    return write_campaign_report(file, file.parent)


def test_the_tidy_table_has_every_evaluation_once(tmp_path: Path) -> None:
    file = write_file(tmp_path, "rewire", "ft1")
    write_runs(file)
    made = report(file)
    table = rows(made.returns)
    assert len(table) == 2 * 3 * 3 * 2
    keys = [
        (row["configuration"], row["seed"], row["stage"], row["task"]) for row in table
    ]
    assert keys == sorted(keys)
    for row in table:
        stage, task, seed = (int(row[name]) for name in ("stage", "task", "seed"))
        expected = SCORES[row["method"]][stage, task - 1] + 200 * seed
        assert float(row["return"]) == expected
        assert row["name"] == TASKS[task - 1]
        assert int(row["training_interactions"]) == 1000 * stage
        assert int(row["selection_interactions"]) == 77
        assert float(row["model_size"]) == 1.5 + 0.25 * stage
        assert (row["success"], row["diverged"]) == ("", "0")
        assert (row["scenario"], row["tuned_on"]) == ("probe/reach", "yes")

    runs = {row["run"]: row for row in rows(made.runs)}
    assert list(runs) == sorted(runs)
    assert len(runs) == 6
    for row in runs.values():
        assert (row["state"], row["commit"], row["device"]) == (
            "finished",
            "abc123",
            "cpu",
        )
        assert row["command"] == "rewire-jax train"
        assert row["versions"] == "jax 0.10.2"
        assert row["first_seed"] == row["last_seed"]


def test_a_population_gives_the_same_rows_and_numbers(tmp_path: Path) -> None:
    single = write_file(tmp_path / "single", "rewire", "ft1")
    together = write_file(tmp_path / "together", "rewire", "ft1", population="always")
    write_runs(single)
    assert len(write_runs(together, population=True)) == 2
    one, other = report(single), report(together)
    assert one.returns.read_bytes() == other.returns.read_bytes()
    assert len(rows(other.runs)) == 2
    (a,), (b,) = one.sections, other.sections
    assert a.improvement == b.improvement
    assert a.pictures() == b.pictures()
    for x, y in zip(
        a.report.numbers.summaries, b.report.numbers.summaries, strict=True
    ):
        assert (x.performance, x.iqm, x.forgetting) == (
            y.performance,
            y.iqm,
            y.forgetting,
        )


def test_known_numbers_with_an_uncertain_reference(tmp_path: Path) -> None:
    file = write_file(tmp_path, "sac_n", "rewire", "ft1")
    write_runs(file)
    (section,) = report(file).sections
    ends = {
        name: scores[-1] + 200 * np.arange(3)[:, None]
        for name, scores in SCORES.items()
    }
    assert section.labels == ["SAC-N", "Ours (rewire)", "FT-1"]
    sac_n, ours, _ = section.report.numbers.summaries
    expected = normalised_iqm(ends["rewire"], ends["sac_n"])
    assert ours.iqm.value == pytest.approx(expected)
    # With SAC-N held fixed the interval would be within the mean of extreme seeds.
    fixed = ends["rewire"] / ends["sac_n"].mean()
    assert ours.iqm.high - ours.iqm.low > np.ptp(fixed, axis=0).mean()
    # SAC-N's own draws divide themselves.
    own = ends["sac_n"]
    apart = stratified_bootstrap(normalised_iqm, own, own.copy())
    assert 2 * (sac_n.iqm.high - sac_n.iqm.low) < np.ptp(apart)
    assert sac_n.performance.mean == 1

    matrix = section.improvement
    assert matrix[1][2].value == 1
    assert matrix[1][2].differs_from(0.5)
    assert matrix[2][1].value == 0
    # The same returns on all tasks.
    same = probability_of_improvement(ends["ft1"], ends["sac_n"])
    assert matrix[2][0].value == same == 0.5
    assert not matrix[2][0].differs_from(0.5)
    assert matrix[0][0] is None
    text = (tmp_path / "report.html").read_text()
    assert 'href="#progress"' not in text  # All runs are finished.
    bold = re.findall(r"<strong>([\d.]+) \[", text)
    assert sorted(bold) == ["0.00", "0.00", "1.00", "1.00"]


def test_unfinished_failed_and_damaged_runs_are_named(tmp_path: Path) -> None:
    file = write_file(tmp_path, "rewire", "ft1")
    jobs = {job.run.name: job for job in write_runs(file)}
    unfinished = jobs["probe/reach/rewire/seed-1"]
    (unfinished.folder / "checkpoints/task-002").rmdir()
    failed = jobs["probe/reach/ft1/seed-2"]
    (failed.folder / "checkpoints/task-002").rmdir()
    for _ in range(2):
        failed.notes.mkdir(parents=True, exist_ok=True)
        (failed.notes / "log.txt").write_text("error: <b>no disk</b>\n")
        failed.note_failure(1)
    damaged = jobs["probe/reach/ft1/seed-0"]
    (damaged.folder / "results.jsonl").unlink()
    made = report(file)
    states = {row["run"]: row["state"] for row in rows(made.runs)}
    assert states.pop(unfinished.run.name) == "missing"
    assert states.pop(failed.run.name) == "failed"
    assert states.pop(damaged.run.name) == "unreadable"
    assert set(states.values()) == {"finished"}
    # What they have is in the table, but does not count.
    found = {(row["configuration"], row["seed"]) for row in rows(made.returns)}
    assert found == {("rewire", s) for s in "012"} | {("ft1", s) for s in "12"}
    seeds = [s.run.seeds for s in made.sections[0].report.numbers.summaries]
    assert seeds == [(0, 2), (1,)]
    assert len(made.sections[0].unfinished) == 2
    text = made.page.read_text()
    assert "3 of 6 runs are finished" in text
    assert "<details open>" in text
    for job in (unfinished, failed, damaged):
        assert text.count(f">{job.run.name}</td>") == 2  # in two tables
    assert "error: &lt;b&gt;no disk" in text


def test_a_campaign_without_results_has_a_page(tmp_path: Path) -> None:
    file = write_file(tmp_path, "rewire", "ft1")
    made = report(file)
    assert made.sections == ()
    assert made.returns.read_text().count("\n") == 1
    assert {row["state"] for row in rows(made.runs)} == {"missing"}
    text = made.page.read_text()
    assert "0 of 6 runs are finished" in text
    assert 'href="#progress"' in text
    assert "<details open>" not in text


def test_the_page_is_one_file_and_escapes_names(tmp_path: Path) -> None:
    text = TEXT.replace(
        'profile = "quick"', """profile = "quick"\nname = '<script>a & "b" $x_{$'"""
    ).replace("Two methods", "</title><script>alert(1)</script>")
    file = write_file(tmp_path, "rewire", text=text)
    write_runs(file)
    page = report(file).page.read_text()
    assert "<script" not in page
    assert "</title>" in page
    assert page.count("</title>") == 1
    assert "&lt;script&gt;a &amp;" in page
    assert not re.search(r"https?:|//[a-z]", re.sub(r"base64,[^\"]*", "", page))
    sources = re.findall(r"<img src=\"([^\"]{30})", page)
    assert len(sources) == 5
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert not re.search(r"<(link|script|iframe|object)", page)


def test_whether_settings_were_tuned_is_said_or_unknown(tmp_path: Path) -> None:
    said = {}
    for name, line in (("none", "tuned_on = []"), ("unknown", "")):
        text = TEXT.replace('tuned_on = ["probe/reach"]', line)
        file = write_file(tmp_path / name, "ft1", text=text)
        write_runs(file)
        made = report(file)
        said[name] = {row["tuned_on"] for row in rows(made.returns)}
    assert said == {"none": {"no"}, "unknown": {"unknown"}}


def test_other_budgets_have_a_section_of_their_own(tmp_path: Path) -> None:
    text = TEXT + TEXT[TEXT.index("[[runs]]") :].replace(
        "[runs.settings]", 'name = "longer"\n[runs.settings]\ninteractions = 50_000'
    )
    file = write_file(tmp_path, "ft1", text=text)
    write_runs(file)
    sections = report(file).sections
    assert [section.labels for section in sections] == [["FT-1"], ["longer"]]
    assert "50,000 interactions a task" in sections[1].report.title


def test_it_replaces_its_own_files_only(tmp_path: Path) -> None:
    file = write_file(tmp_path, "ft1")
    before = report(file).returns.read_text()
    write_runs(file)
    made = report(file)
    assert made.returns.read_text() != before
    made.returns.write_text("mine")
    with pytest.raises(UserError):
        report(file)
    assert made.returns.read_text() == "mine"
