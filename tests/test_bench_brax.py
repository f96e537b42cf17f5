import dataclasses
from pathlib import Path

import pytest

import rewire_jax
from experiments.bench_brax import Bench, run
from rewire_jax.errors import UserError


def test_finished_methods_are_kept_and_all_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    preset = rewire_jax.preset

    def tiny(*arguments):
        quick = preset(*arguments)
        return dataclasses.replace(
            quick,
            tasks=2,
            interactions=320,
            envs=16,
            updates=1,
            warmup=160,
            eval_episodes=2,
            sac=dataclasses.replace(quick.sac, hidden=8, batch_size=8),
        )

    monkeypatch.setattr(rewire_jax, "preset", tiny)
    bench = Bench(scenario="probe/reach", methods=("ft1",), seeds=2, out=tmp_path)
    run(bench)
    results = (tmp_path / "ft1" / "results.jsonl").read_bytes()
    for name in ("report.md", "result.json", "curves.png", "matrix.png"):
        assert (tmp_path / name).stat().st_size > 0
    assert str(tmp_path / "report.md") in capsys.readouterr().out
    run(bench)
    assert "finished before" in capsys.readouterr().err
    assert (tmp_path / "ft1" / "results.jsonl").read_bytes() == results
    with pytest.raises(UserError, match="unknown method"):
        run(dataclasses.replace(bench, methods=("ft1", "magic")))
