from rewire_jax.reports.provenance import how_made, origin
from rewire_jax.storage.run_results import read_run
from rewire_jax.storage.sweep_results import read_sweep
from tests.fake_run import write_run
from tests.fake_sweep import write_sweep


def test_a_run_s_origin_has_every_fact(tmp_path):
    run = read_run(write_run(tmp_path / "run", stages=2, seeds=3, diverged=(1,)))
    assert origin("Ours", run) == (
        f"- Ours: `{tmp_path}/run`; seeds 0, 1, 2 (diverged: 1); 2 of 3 tasks, 1,000 "
        "interactions a task; cpu; commit abc123; jax 0.10.2; started "
        "2025-01-01T00:00:00; command `rewire-jax train`"
    )


def test_a_sweep_s_origin_names_each_seed_once(tmp_path):
    line = origin("all", read_sweep(write_sweep(tmp_path / "sweep")))
    assert "seeds 0, 1; 3 of 3 tasks" in line


def test_results_shown_as_one_say_each_fact_once(tmp_path):
    runs = [
        read_run(write_run(tmp_path / str(seed), seed=seed, seeds=1, stages=stages))
        for seed, stages in ((4, 3), (2, 1))
    ]
    line = origin("both", *runs)
    assert f"`{tmp_path}`; seeds 2, 4; 1 to 3 of 3 tasks" in line
    assert line.count("abc123") == line.count("rewire-jax train") == 1


def test_what_was_not_recorded_is_a_dash():
    one = {"commit": "a", "started": "2025", "device": "cpu", "command": "x"}
    assert how_made(one) == "cpu; commit a; started 2025; command `x`"
    assert how_made(one, one | {"commit": "b", "started": "2026"}) == (
        "cpu; commit a, b; started 2025 to 2026; command `x`"
    )
    assert "commit –" in how_made({})
