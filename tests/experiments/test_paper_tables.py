"""Tables 1 to 3, of runs with known numbers."""

import dataclasses
import json

import numpy as np
import pytest

from experiments import table1_brax, table2_continual_world, table3_ablation
from experiments.table1_brax import Table1
from experiments.table2_continual_world import Table2
from experiments.table3_ablation import Table3
from rewire_jax.core.errors import UserError
from rewire_jax.reports import paper_results
from tests.fake_run import EDGE, GAP, SCORES, rows
from tests.fake_training import NAMES
from tests.reports.test_campaign_report import SCORES as CAMPAIGN_SCORES
from tests.reports.test_campaign_report import TEXT, write_file, write_runs


def performance(factor):
    """Mean and standard deviation over two seeds, divided by SAC-N's."""
    end = SCORES[-1].mean()
    seeds = np.array([factor * end, factor * end + GAP]) / (end + GAP / 2)
    return seeds.mean(), seeds.std(ddof=1)


def test_table1_averages_over_finished_runs(trained, tmp_path, capsys):
    job = Table1(scenarios=NAMES, methods=("ft1", "rewire"), seeds=2, out=tmp_path)
    table1_brax.run(job)
    assert [(f.parent.name, f.name) for f, _, _ in trained] == [
        (f"halfcheetah-{kind}-quick", method)
        for kind in ("forgetting", "transfer")
        for method in ("sac_n", "ft1", "rewire")
    ]
    out = tmp_path / "table1-quick"
    found = {row["method"]: row for row in rows(out / "table1.csv")}
    half, more = performance(0.5), performance(1.5)
    assert float(found["ft1"]["performance"]) == pytest.approx((half[0] + more[0]) / 2)
    assert float(found["ft1"]["performance_std"]) == pytest.approx(half[1])
    assert float(found["ft1"]["paper_performance"]) == 0.62
    assert float(found["rewire"]["performance"]) == pytest.approx(1.0)
    shown = (out / "table1.md").read_text()
    assert "1.00 ± 0.08 (1 of 2 scenarios)" in shown
    assert "1.17 ± 0.15 | 2.1 |" in shown
    assert "Ours (rewire): unfinished, 2 of 3 tasks" in shown
    made = json.loads((out / "table1.json").read_text())
    assert made["provenance"]["commit"]
    assert (out / "halfcheetah-transfer" / "report.md").exists()
    # The same command goes on with the one run that was stopped.
    table1_brax.run(job)
    ((folder, _, resume),) = trained[6:]
    assert folder.name == "rewire"
    assert resume
    assert "finished before" in capsys.readouterr().err
    assert "of 2 scenarios" not in (out / "table1.md").read_text()


def test_table2_averages_success_rates_over_triplets(trained, tmp_path, capsys):
    sequences = [f"continual_world/{name}" for name in ("t1", "t3", "cw10")]
    job = Table2(scenarios=sequences, methods=("rewire", "ft1"), seeds=2, out=tmp_path)
    table2_continual_world.run(job)
    assert {s.scenario for _, s, _ in trained} == set(sequences)
    out = tmp_path / "table2-quick"
    found = {(r["sequences"], r["method"]): r for r in rows(out / "table2.csv")}
    # Seed 1 solves EDGE more, and nothing is divided by SAC-N's.
    for key, rate in {
        ("CW3", "rewire"): (0.4 + 0.8) / 2,
        ("CW3", "ft1"): (0.1 + 0.3) / 2,
        ("CW10", "rewire"): 0.5,
        ("CW10", "ft1"): 0.0,
    }.items():
        row = found[key]
        assert float(row["performance"]) == pytest.approx(rate + EDGE / 2)
        assert float(row["performance_std"]) == pytest.approx(EDGE / 2**0.5)
    assert float(found["CW3", "ft1"]["paper_performance"]) == 0.29
    assert float(found["CW10", "rewire"]["paper_performance"]) == 0.84
    shown = (out / "table2.md").read_text()
    assert shown.startswith(
        "# Table 2 on Meta-World v3, quick profile, reduced budget of 30,000 "
        "interactions a task (paper: 1,000,000), reward v2, mujoco backend\n"
    )
    head = "| method | CW3 | model size | paper | CW10 | model size | paper |"
    assert head in shown
    assert "| Ours (rewire) | 0.65 ± 0.07 | 2.25 | 0.67 ± 0.09 | 0.55 ± 0.07 |" in shown
    assert "Success rates are shares of episodes solved at any" in shown
    # The other rule, from what there is; half is solved at the last step.
    last = dataclasses.replace(job, success="last", train=False)
    table2_continual_world.run(last)
    assert len(trained) == 6
    path = tmp_path / "table2-last-quick" / "table2.csv"
    assert float(rows(path)[0]["performance"]) == pytest.approx((0.6 + EDGE / 2) / 2)
    assert "solved at their last step" in path.with_suffix(".md").read_text()
    assert (tmp_path / "table2-last-quick" / "continual_world-t1").is_dir()
    capsys.readouterr()
    with pytest.raises(UserError, match="not of probe/reach"):
        table2_continual_world.run(Table2(scenarios=("probe/reach",), out=tmp_path))


def test_table2_is_of_nine_sequences_and_all_methods():
    sequences = Table2().scenarios
    assert len(sequences) == len(set(sequences)) == 9
    assert {paper_results.sources(name)[0].table for name in sequences} == {"Table 2"}
    runs = Table2().runs_of(dict.fromkeys(sequences[:1], "CW"))
    assert [run.settings.method for run in runs["CW"]] == list(paper_results.NAMES)


def test_tables_of_what_there_is(trained, tmp_path):
    job = Table1(scenarios=NAMES, methods=("ft1",), out=tmp_path, train=False)
    with pytest.raises(UserError, match="none of the runs has results"):
        table1_brax.run(job)
    table1_brax.run(dataclasses.replace(job, scenarios=NAMES[:1], train=True))
    table1_brax.run(job)
    assert len(trained) == 2
    shown = (tmp_path / "table1-quick" / "table1.md").read_text()
    assert "(1 of 2 scenarios)" in shown


def test_another_run_in_the_folder_is_refused(trained, tmp_path):
    job = Table1(scenarios=NAMES[:1], methods=("ft1",), out=tmp_path)
    table1_brax.run(job)
    with pytest.raises(UserError, match="--seeds was 1, not 3"):
        table1_brax.run(dataclasses.replace(job, seeds=3))
    # Another budget has folders of its own.
    table1_brax.run(dataclasses.replace(job, interactions=20_000))
    assert trained[-1][0].parent.name == "halfcheetah-forgetting-quick-20000"
    assert trained[-1][1].interactions == 20_000


def test_table3_turns_the_designs_on_one_by_one(trained, tmp_path):
    table3_ablation.run(Table3(out=tmp_path))
    options = {folder.name: settings.options for folder, settings, _ in trained}
    assert list(options) == ["sac_n", *table3_ablation.ROWS]
    designs = {
        name: (options[name].caching, options[name].modes, options[name].alignment)
        for name in list(table3_ablation.ROWS)[1:]
    }
    assert designs == {
        "rewire-without-caching-modes-alignment": (False, 1, "off"),
        "rewire-without-modes-alignment": (True, 1, "off"),
        "rewire-without-alignment": (True, 3, "off"),
        "rewire-without-modes": (True, 1, "expanded"),
        "rewire": (True, 3, "expanded"),
    }
    for name in (
        "rewire-without-caching-modes-alignment",
        "rewire-without-modes-alignment",
        "rewire-without-alignment",
    ):
        assert options[name].beta == options["ft_l2"].coefficient == 1e4
    assert options["rewire-without-modes"].beta == options["rewire"].beta == 100
    found = rows(tmp_path / "table3-quick" / "table3.csv")
    assert [row["performance"] for row in found] == ["1.0"] * 6
    published = [float(row["paper_performance"]) for row in found]
    assert published == [0.67, 0.76, 0.95, 1.14, 1.15, 1.31]


@pytest.mark.parametrize(
    ("population", "seeds"), [("never", 2), ("never", 1), ("always", 2)]
)
def test_table3_of_a_campaign(population, seeds, trained, tmp_path):
    text = f"""{TEXT}
[[runs]]
scenarios = ["probe/reach"]
methods = ["rewire"]
name = "rewire without modes, alignment"
profile = "quick"
seeds = {seeds}
[runs.settings]
tasks = 2
modes = 1
alignment = "off"
"""
    made = tmp_path / "made"
    file = write_file(made, "rewire", "sac_n", text=text, population=population)
    write_runs(file, population == "always")
    job = Table3(scenario="probe/reach", campaign=file, trained_in=made, out=tmp_path)
    table3_ablation.run(job)
    assert not trained
    path = tmp_path / "table3-campaign" / "table3.csv"
    found = {row["run"]: row for row in rows(path)}
    assert list(found) == list(table3_ablation.ROWS)
    # Each further seed scores 200 more in every task.
    ours, unit = (CAMPAIGN_SCORES[name][-1].mean() for name in ("rewire", "sac_n"))
    whole, single = found["rewire"], found["rewire-without-modes-alignment"]
    assert (whole["seeds"], single["seeds"]) == ("3", str(seeds))
    assert float(whole["performance"]) == pytest.approx((ours + 200) / (unit + 200))
    mean = ours + 100 * (seeds - 1)
    assert float(single["performance"]) == pytest.approx(mean / (unit + 200))
    assert float(single["paper_performance"]) == 0.95
    assert found["rewire-without-modes"]["performance"] == ""
    assert float(whole["iqm_low"]) < float(whole["iqm"]) < float(whole["iqm_high"])
    # All scores are divided by those of SAC-N, so it is named, too.
    assert "- SAC-N: " in path.with_suffix(".md").read_text()


def test_table3_of_a_campaign_without_sac_n(tmp_path):
    file = write_file(tmp_path / "made", "rewire")
    job = Table3(scenario="probe/reach", campaign=file, trained_in=file.parent)
    with pytest.raises(UserError, match="SAC-N on probe/reach"):
        table3_ablation.run(job)
    write_runs(file)
    with pytest.raises(UserError, match="SAC-N on probe/reach"):
        table3_ablation.run(job)
