import json
from dataclasses import replace
from types import SimpleNamespace

import jax
import pytest

import rewire_jax
from experiments import accelerator, suite
from experiments.accelerator import Accelerator
from experiments.speed.kernels import idle, kernels, loops
from rewire_jax.core.errors import UserError
from rewire_jax.storage import run_folder

PROGRAM = """HloModule jit_f, entry_computation_layout={(f32[2]{0})->f32[2]{0}}

%add (a: f32[], b: f32[]) -> f32[] {
  %a = f32[] parameter(0)
  %b = f32[] parameter(1)
  ROOT %sum = f32[] add(%a, %b)
}

%inner (p: (s32[], f32[2])) -> (s32[], f32[2]) {
  %p = (s32[], f32[2]{0}) parameter(0)
  %x = f32[2]{0} get-tuple-element(%p), index=1
  %y = f32[2]{0} fusion(%x), kind=kLoop, calls=%add
  ROOT %t = (s32[], /*index=1*/f32[2]{0}) tuple(%x, %y)
}

%asked (p: (s32[], f32[2])) -> pred[] {
  ROOT %less = pred[] compare(%p, %p), direction=LT
}

%yes (x: f32[2]) -> f32[2] {
  ROOT %sorted = f32[2]{0} sort(%x), dimensions={0}, to_apply=%asked
}

%no (x: f32[2]) -> f32[2] {
  ROOT %x = f32[2]{0} parameter(0)
}

%outer (p: (s32[], f32[2])) -> (s32[], f32[2]) {
  %w = (s32[], f32[2]{0}) while(%p), condition=%asked, body=%inner
  ROOT %c = f32[2]{0} conditional(%i, %x, %x), branch_computations={%yes, %no}
}

ENTRY %main (x: f32[2]) -> f32[2] {
  %x = f32[2]{0} parameter(0)
  %k = f32[2]{0:T(256)} custom-call(%x), custom_call_target="f", metadata={op_name="a"}
  %r = f32[2]{0} call(%k), to_apply=%yes
  ROOT %w = (s32[], f32[2]{0}) while(%r), condition=%asked, body=%outer, \
backend_config={"known_trip_count":{"n":"8"}}
}
"""


def test_each_loop_of_a_program_has_a_row():
    rows = [tuple(row.values()) for row in loops(PROGRAM)]
    # Loop, depth, trips, kernels, loops and branches in it. A loop of unknown length
    # computes its condition, so the loop in which it is has a kernel more.
    assert rows == [
        ("main", 0, 1, 2, 1, 0),
        ("outer", 1, 8, 2, 1, 1),
        ("inner", 2, None, 1, 0, 0),
    ]


def test_loops_and_branches_that_xla_compiles_are_found():
    def f(x, count):
        def once(i, x):
            return jax.lax.cond(i % 3 == 0, jax.numpy.sort, lambda x: x, x)

        return jax.lax.fori_loop(0, count, once, x)

    whole, body = kernels(jax.jit(f).lower(jax.numpy.ones(300), 5).compile())
    assert whole["while"] == body["conditional"] == 1
    assert (body["depth"], body["trips"]) == (1, None)
    assert body["kernels"] >= 1


def test_a_device_waits_where_no_stream_is_busy():
    # Two streams: busy from 0 to 5 and from 6 to 8, one of them also within.
    assert idle([(6, 8), (0, 4), (3, 5), (1, 2)]) == 1 / 8
    assert idle([(2, 3)]) == 0


def test_failed_steps_are_named_and_made_again_and_finished_ones_are_not(
    tmp_path, monkeypatch, capsys
):
    job = Accelerator(tiny=True, out=tmp_path / "out", work=tmp_path)
    job = replace(job, only=("blocks", "updates-plain-256"))
    with monkeypatch.context() as broken:
        broken.setenv("JAX_PLATFORMS", "none-such")
        with pytest.raises(UserError) as failed:
            accelerator.run(job)
    assert all(step in str(failed.value) for step in job.only)
    assert all("none-such" in job.error(step).read_text() for step in job.only)
    assert not list(job.folder.glob("*.json"))

    accelerator.run(replace(job, only=("blocks",)))
    assert [path.name for path in job.folder.glob("blocks*")] == ["blocks.json"]
    made = (job.folder / "blocks.json").read_bytes()
    result = json.loads(made)
    assert {"command", "commit", "versions", "device"} <= set(result["provenance"])
    cases = [(row["members"], row["block"]) for row in result["rows"]]
    assert cases == [(1, 4), (1, 16), (2, 4), (2, 16)]
    assert all(row["ms"] > 0 for row in result["rows"])

    capsys.readouterr()
    accelerator.run(replace(job, list=True))
    states = [line.split()[0::3] for line in capsys.readouterr().out.splitlines()]
    assert states == [["blocks", "finished"], ["updates-plain-256", "failed"]]
    monkeypatch.setenv("JAX_PLATFORMS", "none-such")
    accelerator.run(replace(job, only=("blocks",)))
    assert (job.folder / "blocks.json").read_bytes() == made


def test_no_step_is_begun_without_the_time_for_it(tmp_path, monkeypatch):
    begun = []
    monkeypatch.setattr(accelerator, "apart", lambda job, *what: begun.append(what))
    job = Accelerator(tiny=True, out=tmp_path, limit="3m", only=("train-ft1", "blocks"))
    accelerator.run(job)
    assert not begun
    accelerator.run(replace(job, limit="1h"))
    assert begun == [(step, accelerator.LONGEST) for step in job.only]


def test_an_unknown_step_is_refused(tmp_path):
    with pytest.raises(UserError, match="blocks"):
        accelerator.run(Accelerator(out=tmp_path / "out", only=("block",)))
    assert not (tmp_path / "out").exists()


def test_training_that_was_stopped_goes_on(tmp_path, monkeypatch):
    resumed = []

    def train(settings, folder, *, resume):
        resumed.append(resume)
        folder.mkdir(exist_ok=True)
        (folder / "settings.json").write_text("{}")
        for table in run_folder.TABLES:
            (folder / table).write_text('{"seconds": 1.0}\n' * len(resumed))
        raise rewire_jax.Stopped("stopped")

    monkeypatch.setattr(rewire_jax, "train", train)
    unfinished = SimpleNamespace(complete=False)
    monkeypatch.setattr(suite, "read_run", lambda folder: unfinished)
    job = Accelerator(tiny=True, out=tmp_path / "out", work=tmp_path, limit="9m")
    job = replace(job, only=("train-ft1",), measure="train-ft1")
    job.folder.mkdir()
    for number in (1, 2):
        accelerator.run(job)
        assert job.state("train-ft1") == "begun"
        result = json.loads((job.folder / "train-ft1.json").read_text())
        assert result["rows"] == [{"seconds": 1.0}] * number
    assert resumed == [False, True]
    copied = {path.name for path in (job.folder / "train-ft1").iterdir()}
    assert copied == {"settings.json", *run_folder.TABLES}


@pytest.mark.slow
def test_all_steps_run(tmp_path):
    job = Accelerator(tiny=True, out=tmp_path / "out", work=tmp_path)
    accelerator.run(job)
    for step in accelerator.steps():
        assert job.state(step) == "finished"
