"""Checkpoints and tables that are not those of the run in whose folder they are."""

import dataclasses
import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import rewire_jax
from rewire_jax import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.core.settings_json import digest
from rewire_jax.run import run_checkpoints, run_state
from rewire_jax.storage.run_folder import TABLES
from rewire_jax.training.run_setup import prepare
from tests.tiny import tiny


def small(**changes) -> Settings:
    return dataclasses.replace(tiny(method="ft1"), tasks=2, **changes)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rewire_jax.train(small(), tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    return shutil.copytree(trained, tmp_path / "run")


def rows(folder: Path, name: str = "results.jsonl") -> bytes:
    return (folder / name).read_bytes()


def copies(folder: Path, table: str) -> list[bytes]:
    return [path.read_bytes() for path in folder.glob(f"{table}.*")]


def test_what_no_checkpoint_belongs_to_is_kept_as_a_copy(
    run: Path, trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(run / "checkpoints")
    (run / "results.jsonl").write_bytes(rows(trained).replace(b"\n", b"\r\n"))
    held = {table: rows(run, table) for table in TABLES}
    rewire_jax.train(small(), run, resume=True)
    assert "results.jsonl" in capsys.readouterr().err
    for table in TABLES:
        assert copies(run, table) == [held[table]]
    assert rows(run) == rows(trained)


def test_a_fallback_keeps_a_copy_and_a_plain_resume_none(
    run: Path, trained: Path
) -> None:
    table = run / "training.jsonl"
    table.write_bytes(rows(run, "training.jsonl") + b'{"half a row')
    rewire_jax.train(small(), run, resume=True)
    assert not copies(run, "training.jsonl")
    assert rows(run, "training.jsonl") == rows(trained, "training.jsonl")
    (run / "checkpoints/task-002/manifest.json").unlink()
    rewire_jax.train(small(), run, resume=True)
    assert copies(run, "results.jsonl") == [rows(trained)]
    assert rows(run) == rows(trained)


def test_evaluations_after_the_newest_checkpoint_are_kept_as_a_copy(
    run: Path, trained: Path
) -> None:
    shutil.rmtree(run / "checkpoints/task-002")
    rewire_jax.train(small(), run, resume=True)
    assert copies(run, "results.jsonl") == [rows(trained)]
    assert rows(run) == rows(trained)


@pytest.mark.parametrize("kind", ["file", "link"])
def test_what_stands_in_a_checkpoints_way_is_replaced(
    kind: str, run: Path, trained: Path, tmp_path: Path
) -> None:
    path, outside = run / "checkpoints/task-002", tmp_path / "outside"
    path.rename(outside)
    if kind == "file":
        path.touch()
    else:
        (outside / "manifest.json").unlink()
        path.symlink_to(outside)
    before = {p: p.read_bytes() for p in outside.rglob("*") if p.is_file()}
    rewire_jax.train(small(), run, resume=True)
    assert rows(run) == rows(trained)
    assert path.is_dir()
    assert not path.is_symlink()
    assert {p: p.read_bytes() for p in before} == before


@pytest.mark.parametrize("change", [{"seed": 5}, {"warmup": 320}])
def test_another_runs_checkpoint_is_never_used(
    change: dict, run: Path, trained: Path
) -> None:
    plan = prepare(small(**change))
    state = run_state.start(plan)._replace(stage=2)
    run_checkpoints.save(run.parent / "other", state, plan)
    shutil.rmtree(run / "checkpoints/task-002")
    shutil.move(run.parent / "other/checkpoints/task-002", run / "checkpoints")
    for use in (
        lambda: rewire_jax.evaluate(run, episodes=1),
        lambda: rewire_jax.load_policy(run, task=0),
        lambda: rewire_jax.load_policies(run),
    ):
        with pytest.raises(UserError, match="task-002"):
            use()
    rewire_jax.load_policies(run, stage=0)
    rewire_jax.train(small(), run, resume=True)
    assert rows(run) == rows(trained)
    rewire_jax.load_policies(run)


@pytest.mark.parametrize("task", [-1, 2])
def test_a_task_that_is_not_there(task: int, trained: Path) -> None:
    policies = rewire_jax.load_policies(trained)
    learned = jax.tree.map(lambda leaf: leaf[0], policies.members)
    with pytest.raises(ValueError, match="task"):
        policies.act(learned, task, jnp.zeros(2))
    assert policies.act(learned, 1, jnp.zeros(2)).shape == (2,)


def test_a_member_that_is_not_there(trained: Path) -> None:
    policies = rewire_jax.load_policies(trained)
    last = policies.member(policies.seeds[-1])
    whole = jax.tree.map(lambda leaf: leaf[-1], policies.members)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, last, whole))
    with pytest.raises(rewire_jax.UserError, match="seed"):
        policies.member(policies.seeds[-1] + 1)
    # All members are no member; vmap makes one of each.
    with pytest.raises(AssertionError):
        policies.act(policies.members, 0, jnp.zeros(2))
    every = jax.vmap(policies.act, (0, None, None))(policies.members, 0, jnp.zeros(2))
    assert every.shape == (len(policies.seeds), 2)


def test_an_older_checkpoint_does_not_take_the_latests_place(run: Path) -> None:
    (run / "checkpoints/task-002/manifest.json").unlink()
    with pytest.raises(UserError, match="task-002"):
        rewire_jax.load_policies(run)


def test_a_report_refuses_rows_that_the_run_did_not_write(
    run: Path, tmp_path: Path
) -> None:
    rewire_jax.write_report([run], tmp_path / "report")
    held = rows(run)
    digit = next(
        i for i in reversed(range(len(held))) if held[i : i + 1] in b"12345678"
    )
    other = bytes([held[digit] + 1])
    (run / "results.jsonl").write_bytes(held[:digit] + other + held[digit + 1 :])
    with pytest.raises(UserError, match=r"results\.jsonl"):
        rewire_jax.write_report([run], tmp_path / "report")
    rewire_jax.train(small(), run, resume=True)
    rewire_jax.write_report([run], tmp_path / "report")
    # Rows that came after the checkpoint are those of a run that goes on.
    row = json.loads((run / "timing.jsonl").read_text().splitlines()[-1])
    with (run / "timing.jsonl").open("a") as table:
        table.write(json.dumps(row | {"interactions": row["interactions"] + 16}) + "\n")
    rewire_jax.write_report([run], tmp_path / "report")


def test_nothing_is_written_through_a_link(run: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    shutil.move(run / "results.jsonl", outside)
    (run / "results.jsonl").symlink_to(outside)
    shutil.rmtree(run / "checkpoints/task-002")
    held = outside.read_bytes()
    with pytest.raises(UserError, match=r"results\.jsonl"):
        rewire_jax.train(small(), run, resume=True)
    assert outside.read_bytes() == held


@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_folder_of_checkpoints_that_is_none(kind: str, run: Path) -> None:
    shutil.move(run / "checkpoints", run.parent / "elsewhere")
    if kind == "file":
        (run / "checkpoints").touch()
    else:
        (run / "checkpoints").symlink_to(run.parent / "elsewhere")
    held = rows(run)
    with pytest.raises(UserError, match="checkpoints"):
        rewire_jax.train(small(), run, resume=True)
    assert rows(run) == held


def test_a_digest_tells_values_apart_and_ignores_defaults() -> None:
    settings = small()
    other = dataclasses.replace(
        settings, sac=dataclasses.replace(settings.sac, discount=0.5)
    )
    assert digest(settings) == digest(dataclasses.replace(settings))
    assert digest(settings) != digest(other)
    assert digest(1, settings.sac) != digest(2, settings.sac)
