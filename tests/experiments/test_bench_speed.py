import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import bench_speed
from experiments.speed import loops, permutation
from experiments.speed.part import Effort
from experiments.speed.products import multiply_adds, products
from experiments.speed.timing import Timing, in_turn
from experiments.speed.updates import updates
from rewire_jax.core.errors import UserError
from rewire_jax.methods.spec import Spec
from rewire_jax.storage import run_folder
from rewire_jax.training.run_setup import prepare


def quick(folder, *parts):
    job = bench_speed.Bench(parts=parts, out=folder, quick=True)
    return {name: result["rows"] for name, result in bench_speed.run(job).items()}


def nothing(count):
    time.sleep(1e-4 * count)


@pytest.mark.slow
def test_updates_are_measured_against_products(tmp_path, capsys):
    rows = {row["loop"]: row for row in quick(tmp_path / "new", "updates")["updates"]}
    plain = {"square", "shapes", "plain/2"}
    assert set(rows) == plain | {"rewire/2", "tuned/2"}
    for name, row in rows.items():
        assert len(row["seconds"]) == 2
        assert row["best"] >= row["median"] > 0
        assert ("multiply_adds" in row) == ("share" in row) == (name in plain)
        assert ("cost" in row) == (name not in plain)
    assert rows["square"]["share"] == 1
    printed = capsys.readouterr().out
    assert all(name in printed for name in rows)


@pytest.mark.slow
def test_groups_have_no_branch_and_fewer_kernels(tmp_path):
    rows = quick(tmp_path, "kernels")["kernels"]
    counts = {(row["policy"], row["form"]): row for row in rows}
    for policy in ("plain", "rewire"):
        branches, groups = counts[policy, "a branch in each"], counts[policy, "groups"]
        assert branches["conditional"] == 2
        assert groups["conditional"] == 0
        assert 0 < groups["kernels"] < branches["kernels"]


def test_a_part_is_measured_anew_and_the_others_are_kept(tmp_path):
    kept = {"rows": [{"loop": "kept", "best": 2.0}], "seconds": 1.0, "load": [0.0, 0.0]}
    kept |= {"rounds": 1, "provenance": run_folder.provenance()}
    kept |= {"reading": "As it was read then."}
    run_folder.write(tmp_path / "result.json", {"updates": kept})
    rows = quick(tmp_path, "permutation")
    assert rows["updates"] == kept["rows"]
    report = (tmp_path / "report.md").read_text()
    assert "`kept`" in report
    assert "As it was read then." in report


def test_an_unknown_part_is_refused(tmp_path):
    with pytest.raises(UserError, match="choose from updates"):
        quick(tmp_path, "colour")


def test_ratios_are_medians_within_rounds():
    # In the second round the machine was busy for both, in the third for one.
    one, other = Timing(10, [1.0, 10.0, 1.0]), Timing(20, [4.0, 40.0, 400.0])
    assert one.over(other) == pytest.approx((10 / 1) / (20 / 4))
    assert one.best == 10
    assert other.median == 0.5


def test_loops_take_turns():
    calls = []

    def loop(name, count):
        calls.append(name)
        nothing(count)

    both = {name: functools.partial(loop, name) for name in "ab"}
    timings = in_turn(both, rounds=3, seconds=1e-3)
    assert calls[-6:] == ["a", "b"] * 3
    assert all(timing.repeats % 2 == 0 for timing in timings.values())


def test_multiply_adds_by_hand():
    spec = Spec(observations=2, actions=1, hidden=5, depth=1, tasks=1)
    critics, policy = map(multiply_adds, products(spec, 7))
    p, c = 2 * 5 + 5 * 2, 3 * 5 + 5
    assert critics == 7 * (p + 2 * (4 * c - 3 * 5))
    assert policy == 7 * (3 * p - 2 * 5 + 2 * (2 * c - 2 * 5))


def test_multiply_adds_are_those_of_the_compiled_update():
    settings = Effort().settings("ft1", hidden=128, depth=2, batch_size=128)
    state, advance, batches = updates(settings)
    compiled = jax.jit(advance).lower(state, batches, 3).compile()
    # XLA counts the body of a loop once, of a branch the dearer side, and what is not
    # a matrix product too.
    counted = compiled.cost_analysis()["flops"]
    critics, policy = products(prepare(settings).spec, 128)
    expected = 2 * multiply_adds(critics + policy)
    assert expected < counted < 1.15 * expected


def test_environments_and_permutation_have_a_row_for_each_case(tmp_path):
    rows = quick(tmp_path, "permutation", "environments")
    assert [row["hidden"] for row in rows["permutation"]] == [8, 16]
    one, four = rows["environments"]
    assert (one["count"], four["count"]) == (1, 4)
    assert one["gain"] == 1
    assert four["steps_per_second"] == pytest.approx(4 * four["best"])
    text = (tmp_path / "report.md").read_text()
    for name in rows:
        assert f"({name}.png)" in text
        assert (tmp_path / f"{name}.png").stat().st_size > 1000


def test_the_dense_form_is_the_permutation():
    key = jax.random.key(0)
    x, scores = jax.random.normal(key, (5, 9)), jax.random.uniform(key, (9,))

    def loss(function):
        return lambda x, scores: jnp.sum(jnp.sin(function(x, scores, 0.2)))

    for argument in (0, 1):
        dense, ours = (
            jax.grad(loss(function), argument)(x, scores)
            for function in (permutation.dense, permutation.permute)
        )
        np.testing.assert_allclose(dense, ours, atol=1e-5)


def test_peers_that_are_not_there_are_named(monkeypatch, tmp_path):
    monkeypatch.setattr(loops, "version", lambda package: None)
    monkeypatch.setattr(loops, "make", lambda *_: (nothing, nothing))
    rows = quick(tmp_path, "loops")["loops"]
    assert {row["name"] for row in rows} == {loops.OURS, *loops.PEERS}
    text = (tmp_path / "report.md").read_text()
    assert text.count("| not installed |") == 1 + sum(
        len(peer.cases) for peer in loops.PEERS.values()
    )


def test_where_a_peer_is_ahead_the_table_says_so():
    row = {"name": "SBX", "whole_ratios": {"plain": 1.25, "rewire": 0.75}}
    assert loops.PART.columns["our plain loop"](row) == "1.25"
    assert loops.PART.columns["our rewire loop"](row) == "**0.75**"


@pytest.mark.slow
def test_all_parts_run(tmp_path):
    rows = quick(tmp_path)
    assert set(rows) == set(bench_speed.PARTS)
    assert [row["cache"] for row in rows["startup"]] == ["empty", "filled"]
    assert rows["startup"][1]["share"] < 1
    assert rows["loops"][0]["whole_ratios"]["rewire"] == 1
