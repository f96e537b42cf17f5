"""Arguments of the experiments that are wrong."""

import sys

import pytest

from experiments import (
    bench_brax,
    bench_cw,
    figure4_tradeoff,
    figure5_evolution,
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
        (figure5_evolution, FirstTask, "--scenario probe/reach --campaign no.toml"),
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
