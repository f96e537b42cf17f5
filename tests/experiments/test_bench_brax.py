import dataclasses
import json
import os
import signal
from pathlib import Path

import pytest

import rewire_jax
from experiments.bench_brax import Bench, run
from rewire_jax.core.errors import UserError
from rewire_jax.run.progress import Progress
from tests.tiny import shrink_presets


class Killed(BaseException):
    pass


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    shrink_presets(monkeypatch, hidden=8, tasks=2, interactions=320, updates=1)
    return Bench(scenario="probe/reach", methods=("ft1",), seeds=2, out=tmp_path)


def test_finished_methods_are_kept_and_a_stopped_one_goes_on(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, train = bench.out, rewire_jax.train
    assert out is not None
    ends = iter(["kill", "stop"])

    class Ending(Progress):
        """Ends the second method at its first progress report."""

        def update(self, *arguments, **options):
            super().update(*arguments, **options)
            if self._label.startswith("ft_n"):
                end = next(ends, None)
                if end == "kill":
                    raise Killed
                if end == "stop":
                    os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(
        rewire_jax, "train", lambda *a, **k: train(*a, progress=Ending, **k)
    )
    both = dataclasses.replace(bench, methods=("ft1", "ft_n"))
    with pytest.raises(Killed):
        run(both)
    results = (out / "ft1" / "results.jsonl").read_bytes()
    assert not list((out / "ft_n").glob("checkpoints/*"))
    # As if killed before the first evaluation.
    (out / "ft_n" / "results.jsonl").unlink()
    with pytest.raises(rewire_jax.Stopped):
        run(both)
    assert "ft1: finished before" in capsys.readouterr().err
    assert list((out / "ft_n").glob("checkpoints/*"))
    run(both)
    said = capsys.readouterr()
    assert "ft1: finished before" in said.err
    assert "ft_n: finished before" not in said.err
    assert (out / "ft1" / "results.jsonl").read_bytes() == results
    # Nothing was run twice: before training and after two tasks, of two seeds each.
    assert len((out / "ft_n" / "results.jsonl").read_text().splitlines()) == 12
    made = json.loads((out / "result.json").read_text())
    assert [one["complete"] for one in made["runs"]] == [True, True]
    for name in ("report.md", "curves.png", "matrix.png"):
        assert (out / name).stat().st_size > 0
    assert str(out / "report.md") in said.out


def test_wrong_names_run_nothing(bench: Bench) -> None:
    with pytest.raises(UserError, match="unknown method"):
        run(dataclasses.replace(bench, methods=("ft1", "magic")))
    assert bench.out is not None
    assert not list(bench.out.iterdir())
