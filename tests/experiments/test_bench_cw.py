"""Experiments on Continual World outside the paper's table."""

import dataclasses

import numpy as np
import pytest

from experiments import bench_cw
from tests.fake_run import EDGE, rows


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
