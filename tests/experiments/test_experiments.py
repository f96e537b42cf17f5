import dataclasses
import itertools
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import rewire_jax
from experiments import (
    bench_brax,
    bench_cw,
    figure4_tradeoff,
    figure5_evolution,
    model_sizes,
    pink_noise,
    suite,
    table1_brax,
    table2_continual_world,
    table3_ablation,
)
from experiments.figure4_tradeoff import Figure4
from experiments.first_task import FirstTask
from experiments.table1_brax import Table1
from experiments.table2_continual_world import Table2
from experiments.table3_ablation import Table3
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings_json import to_json
from rewire_jax.envs.scenarios import SCENARIOS
from rewire_jax.methods import METHODS
from rewire_jax.reports import paper_results
from tests.fake_run import EDGE, GAP, SCORES, rows, write_cw, write_run

NAMES = ("halfcheetah/forgetting", "halfcheetah/transfer")


@pytest.fixture
def trained(monkeypatch):
    """Scenarios without physics, and training that writes numbers; what was called."""
    for name in NAMES:
        spec = dataclasses.replace(SCENARIOS["probe/reach"], name=name)
        monkeypatch.setitem(SCENARIOS, name, spec)
    calls = []

    def train(settings, folder, *, scenario, resume):
        assert scenario.name == settings.scenario
        # Rewire stops on the way in the second scenario.
        stop = settings.method == "rewire" and settings.scenario == NAMES[1]
        calls.append((folder, settings, resume))
        if resume:
            (folder / "settings.json").unlink()
            folder.rename(folder.with_suffix(".before"))
        options = settings.options.checked()
        facts = to_json(dataclasses.replace(settings, options=options))
        known = {name: facts[name] for name in ("method", "seeds", "seed", "profile")}
        if settings.scenario.startswith("continual_world/"):
            names = tuple(task.name for task in scenario.tasks[: settings.tasks])
            rate = RATE[settings.method, settings.scenario]
            shape = len(names) + 1, len(names)
            write_cw(
                folder,
                tasks=names,
                stages=len(names),
                scores=np.zeros(shape),
                rates=np.full(shape, rate),
                learning=np.full((len(names), 3), rate),
                **known,
            )
        else:
            write_run(
                folder,
                stages=2 if stop and not resume else 3,
                scores=SCORES * FACTORS.get((settings.method, settings.scenario), 1.0),
                **known,
            )
        head = json.loads((folder / "settings.json").read_text())
        head["settings"] |= facts
        (folder / "settings.json").write_text(json.dumps(head))

    monkeypatch.setattr(rewire_jax, "train", train)
    return calls


RATE = {
    ("rewire", "continual_world/t1"): 0.4,
    ("rewire", "continual_world/t3"): 0.8,
    ("rewire", "continual_world/cw10"): 0.5,
    ("ft1", "continual_world/t1"): 0.1,
    ("ft1", "continual_world/t3"): 0.3,
    ("ft1", "continual_world/cw10"): 0.0,
    ("ft1", "continual_world/window-close"): 0.5,
    ("ft1", "continual_world/handle-press-side"): 0.6,
    ("ft1", "continual_world/peg-unplug-side"): 0.7,
}
FACTORS = {("ft1", NAMES[0]): 0.5, ("ft1", NAMES[1]): 1.5}


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
        "# Table 2 on Meta-World v3, quick profile, 30,000 interactions a task, "
        "reward v2, mujoco backend, reduced budget (paper: 1,000,000)\n"
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
    assert [run.settings.method for run in runs["CW"]] == list(METHODS)


def test_bench_on_continual_world_measures_transfer_if_asked(trained, tmp_path, capsys):
    bench = bench_cw.Bench(seeds=2, out=tmp_path)
    bench_cw.run(bench)
    assert [(s.scenario, s.method) for _, s, _ in trained] == [
        ("continual_world/t3", "rewire"),
        ("continual_world/t3", "ft1"),
    ]
    assert "forward_transfer_mean" not in rows(tmp_path / "report.csv")[0]
    # Without training, the runs of each task alone are missed, and said to be.
    asked = dataclasses.replace(bench, transfer=True)
    bench_cw.run(dataclasses.replace(asked, train=False))
    assert "no forward transfer before" in capsys.readouterr().err
    bench_cw.run(asked)
    assert [(s.scenario, s.method, s.tasks) for _, s, _ in trained[2:]] == [
        (f"continual_world/{name}", "ft1", 1)
        for name in ("window-close", "handle-press-side", "peg-unplug-side")
    ]
    row = rows(tmp_path / "report.csv")[0]
    # What is trained at 0.8 throughout, against 0.5, 0.6 and 0.7; one seed EDGE above.
    alone = np.array([0.5, 0.6, 0.7]) + EDGE / 2
    transfer = np.mean((0.8 + EDGE / 2 - alone) / (1 - alone))
    assert float(row["forward_transfer_mean"]) == pytest.approx(transfer)
    # Of a shortened sequence only what is trained is learned alone.
    short = dataclasses.replace(asked, tasks=2, interactions=1_000)
    assert [run.folder.parent.name for run in bench_cw.single(short)] == [
        "continual_world-window-close-quick-1000",
        "continual_world-handle-press-side-quick-1000",
    ]


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
        "rewire-uncached": (False, 1, "off"),
        "rewire-cached": (True, 1, "off"),
        "rewire-modes": (True, 3, "off"),
        "rewire-aligned": (True, 1, "expanded"),
        "rewire": (True, 3, "expanded"),
    }
    for name in ("rewire-uncached", "rewire-cached", "rewire-modes"):
        assert options[name].beta == options["ft_l2"].coefficient == 1e4
    assert options["rewire-aligned"].beta == options["rewire"].beta == 100
    found = rows(tmp_path / "table3-quick" / "table3.csv")
    assert [row["performance"] for row in found] == ["1.0"] * 6
    published = [float(row["paper_performance"]) for row in found]
    assert published == [0.67, 0.76, 0.95, 1.14, 1.15, 1.31]


def test_figure4_has_narrower_and_wider_policies(trained, tmp_path):
    job = Figure4(scenarios=NAMES[:1], out=tmp_path)
    figure4_tradeoff.run(job)
    width = {f.name: s.options.width for f, s, _ in trained if "-" in f.name}
    assert width == {"csp-s": 88, "ours-l": 192}
    found = {row["method"]: row for row in rows(tmp_path / "figure4-quick/figure4.csv")}
    assert len(found) == 11
    assert float(found["FT-1"]["performance"]) == pytest.approx(0.5)
    assert (tmp_path / "figure4-quick" / "figure4.png").stat().st_size > 0
    paper = figure4_tradeoff.variants(Figure4(profile="paper"), NAMES[0])
    assert paper["csp-s"] == ("csp", {"width": 175})
    assert paper["ours-l"] == ("rewire", {"width": 384})


def test_pink_noise_differs_in_the_noise_alone(trained, tmp_path):
    pink_noise.run(FirstTask(seeds=2, out=tmp_path))
    assert [folder.name for folder, *_ in trained] == ["seed-0"] * 3 + ["seed-1"] * 3
    assert [settings.seed for _, settings, _ in trained] == [0] * 3 + [1] * 3
    runs = {f.parent.name: settings for f, settings, _ in trained[:3]}
    colors = {name: settings.sac.noise_color for name, settings in runs.items()}
    assert colors == {"ft1-white": 0, "ft1-pink": 1, "rewire-white": 0}
    sac = dataclasses.replace(runs["ft1-white"].sac, noise_color=1)
    assert dataclasses.replace(runs["ft1-white"], sac=sac) == runs["ft1-pink"]
    assert {settings.tasks for settings in runs.values()} == {1}
    out = tmp_path / "pink-noise-quick-tasks-1"
    # After the first task: FT-1 has half of 1000 and GAP more, the other all of it.
    shown = (out / "pink-noise.md").read_text()
    assert "- FT-1: **600 ± 141**\n- FT-1, pink noise: **600 ± 141**" in shown
    assert "- Ours: **1,100 ± 141**" in shown
    found = rows(out / "pink-noise.csv")
    assert [row["run"] for row in found] == [name for name in runs for _ in range(6)]
    # Training returns of seeds 0 and 1, without a value at first.
    values = ["", "500.0", "1000.0", "", "800.0", "1300.0"]
    assert [row["value"] for row in found[:6]] == values
    after = ["", "", "500.0", "", "", "700.0"]
    assert [row["deterministic"] for row in found[:6]] == after
    assert (out / "pink-noise.png").stat().st_size > 0


def test_figure5_turns_modes_and_distillation_off(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "RESULTS", tmp_path / "kept")
    job = FirstTask(out=tmp_path, seeds=2, keep=True)
    figure5_evolution.run(job)
    chosen = {f.parent.name: s for f, s, _ in trained}
    assert {s.tasks for s in chosen.values()} == {1}
    ours, alone = chosen["rewire"].options, chosen["rewire-k1"].options
    undistilled = chosen["rewire-undistilled"].options
    assert (ours.modes, undistilled.modes, alone.modes) == (3, 3, 1)
    assert (ours.alpha, undistilled.alpha) == (1e-5, 0)
    assert dataclasses.replace(undistilled, alpha=1e-5) == ours
    assert chosen["ft1"].method == "ft1"
    # Seed 1 earns 300 more, and the first report of all has no reward.
    path = tmp_path / "kept/figure5-quick-tasks-1/figure5.csv"
    found = [row for row in rows(path) if row["run"] == "ft1"]
    assert [row["value"] for row in found[3:]] == ["", "800.0", "1300.0"]
    assert path.with_suffix(".png").stat().st_size > 0
    shown = path.with_suffix(".md").read_text()
    assert "| FT-1 | 2 | 1,150 | 1,150 | 1,000 to 1,300 | 0 of 2 | not | 600 |" in shown
    assert "| FT-1 | 1,000 / 500 | 1,300 / 700 |" in shown
    # What is there is shown without what is not.
    job = dataclasses.replace(job, seeds=3, train=False)
    figure5_evolution.run(job)
    assert "rewire-k1/seed-2" in path.with_suffix(".md").read_text()
    some = dataclasses.replace(job, variants=("ft1", "rewire"), seed=2, train=True)
    trained.clear()
    figure5_evolution.run(some)
    assert [f.parent.name for f, *_ in trained] == ["ft1", "rewire"] * 3


@pytest.mark.parametrize(
    ("module", "kind", "arguments"),
    [
        (bench_brax, bench_brax.Bench, "--methods ft1 magic"),
        (bench_brax, bench_brax.Bench, "--scenario probe/rech"),
        (bench_cw, bench_cw.Bench, "--transfer --scenario probe/reach"),
        (table2_continual_world, Table2, "--scenarios continual_world/t9"),
        (table1_brax, Table1, "--methods magic"),
        (table1_brax, Table1, "--scenarios probe/reach probe/rech"),
        (table3_ablation, Table3, "--scenario probe/reach --profile slow"),
        (figure4_tradeoff, Figure4, "--scenarios probe/reach --interactions 3"),
        (figure5_evolution, FirstTask, "--scenario probe/reach --tasks 9"),
        (figure5_evolution, FirstTask, "--scenario probe/reach --variants ft2"),
    ],
)
def test_what_is_wrong_ends_in_a_line_before_anything_runs(
    module, kind, arguments, trained, tmp_path, monkeypatch, capsys
):
    name = module.__name__.removeprefix("experiments.")
    if "scenario" not in arguments:
        arguments += f" --scenario{'s' if kind is Table1 else ''} probe/reach"
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", [name, *arguments.split(), "--out", str(out)])
    with pytest.raises(SystemExit) as caught:
        suite.command(kind, module.run, name)
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert not trained
    assert not out.exists()


COMMITTED = Path(__file__).parents[2] / "experiments/results/model-sizes.json"
HEADS = {"halfcheetah/robustness": 2, "ant/robustness": 2}


def formula(method, row):
    """Numbers stored at the most, written out a second time."""
    o, a, n = row["observations"], row["actions"], row["hidden"]
    tasks, w = row["tasks"], 96

    def plain(width):
        sizes = [o, width, width, width, 2 * a]
        return sum(i * j + j for i, j in itertools.pairwise(sizes))

    column = plain(w)
    outer = 2 * (w * w + w) + w * 2 * a + 2 * a + 3
    inner = sum(3 * (w * place) * w for place in range(tasks))
    heads = HEADS.get(row["scenario"], 4)
    head = n * 2 * a + 2 * a
    scores, orders, adapters = 3 * 3 * n, heads * 3 * n, 3 * n + 2 * n
    hidden = plain(n) - head
    return {
        "ft1": plain(n),
        "ft_l2": 2 * plain(n),
        "packnet": 2 * plain(n),
        "ewc": 3 * plain(n),
        "pnn": tasks * column + (tasks - 1) * outer + inner,
        "sac_n": tasks * plain(n),
        "ft_n": tasks * plain(n),
        "csp": tasks * plain(n),
        "rewire": 2 * hidden + (heads + 1) * head + scores + orders + adapters,
    }[method]


def test_committed_model_sizes_follow_the_formulas():
    found = json.loads(COMMITTED.read_text())["rows"]
    assert {row["scenario"] for row in found} == {
        name for names in suite.DOMAINS.values() for name in names
    }
    for row in found:
        assert row["most"] == formula(row["method"], row), row
        least = row["plain"] if row["method"] == "csp" else row["most"]
        assert row["least"] == least
        assert row["plain"] == formula("ft1", row)
    shown = COMMITTED.with_suffix(".md").read_text()
    for line in model_sizes.table(found):
        assert f"| {' | '.join(line)} |" in shown


def test_model_sizes_are_those_committed():
    name = "halfcheetah/robustness"
    found = json.loads(COMMITTED.read_text())["rows"]
    expected = [r for r in found if r["scenario"] == name and r["observations"] == 18]
    assert len(expected) == 9
    assert list(itertools.islice(model_sizes.measure(name), 9)) == expected
