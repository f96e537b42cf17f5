import json
import shutil
import sys
from pathlib import Path

import pytest

import rewire_jax
from rewire_jax.cli import commands, main
from rewire_jax.storage import checkpoint
from rewire_jax.storage.run_folder import HEADER
from tests.command_line import TINY, fails
from tests.fake_run import TRIPLET, write_alone, write_cw


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cli") / "run"
    main.main(["train", "probe/reach", "--out", str(folder), *TINY])
    return folder


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("halfcheetah/forgeting", "halfcheetah/forgetting"),
        ("probe/reach --method rewired", "rewire"),
        ("probe/reach --profile fast", "quick"),
        ("ant/transfer --backend bullet", "positional"),
        ("probe/reach --modes 0", "--modes"),
        ("probe/reach --modes 3 --mode-slots 2", "--mode-slots"),
        ("probe/reach --beta -1", "--beta"),
        ("probe/reach --beta nan", "--beta"),
        ("probe/reach --tau 0", "--tau"),
        ("probe/reach --dropout 1", "--dropout"),
        ("probe/reach --seeds 0", "--seeds"),
        ("probe/reach --seed -1", "--seed"),
        ("probe/reach --tasks 5", "--tasks"),
        ("probe/reach --lr-policy 0", "--lr-policy"),
        ("probe/reach --discount 1.5", "--discount"),
        ("probe/reach --noise-color -1", "--noise-color"),
        ("probe/reach --noise-color inf", "--noise-color"),
        ("probe/reach --warmup 20000", "--warmup"),
        ("probe/reach --envs 0", "--envs"),
        ("probe/reach --seeds many", "many"),
        ("probe/reach --sedes 3", "--seeds"),
        ("probe/reach --seeds 99999999999", "4096"),
        ("probe/reach --hidden 2000000000", "--seeds"),
        ("probe/reach --scenario ant/transfer", "--scenario"),
        ("probe/reach --backend mjx", "--backend"),
        ("probe/reach --time-limit never", "never"),
        ("", "scenario"),
    ],
)
def test_bad_settings(
    words: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert named in fails(capsys, "train", *words.split(), "--out", str(out))
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("", "evaluate"),
        ("play", "evaluate"),
        ("train probe/reach", "--out"),
        ("train --seeds 3 probe/reach --out x", "scenario"),
        ("list --cache", "--cache"),
        ("sweep probe/reach --out x --axis tau", "--axis"),
        ("sweep probe/reach --out x --axis tau high", "--axis"),
        ("sweep probe/reach --out x --modes 1 --axis modes 2", "modes"),
        ("train probe/reach --out=", "--out"),
        ("report --out= x", "--out"),
        ("evaluate x --episodes 999999999999", "--episodes"),
        ("evaluate x --task-label guessed", "--task-label"),
        ("evaluate x --trials few", "--trials"),
        ("sweep probe/reach --out x --axis tau 1 9 --random 999999999999", "--random"),
    ],
)
def test_bad_arguments(
    words: str, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert named in fails(capsys, *words.split())


def test_a_terminal_gets_a_plain_line_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    error = fails(capsys, "train", "probe/reach", "--out", "x", "--sedes", "3")
    assert "--seeds" in error
    assert error.isascii()
    assert error.rstrip().isprintable()


def test_flags_of_all_commands(capsys: pytest.CaptureFixture[str]) -> None:
    main.main(["--version"])
    assert rewire_jax.__version__ in capsys.readouterr().out
    with pytest.raises(SystemExit) as exit_:
        main.main(["--help"])
    assert exit_.value.code == 0
    shown = capsys.readouterr().out
    for word in ("--cache", "--debug", "--version", *commands.COMMANDS):
        assert word in shown


def test_folders_that_do_not_fit(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    train = ["train", "probe/reach", *TINY, "--out"]
    assert "--out" in fails(capsys, *train, run)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").touch()
    assert "--out" in fails(capsys, *train, tmp_path / "foreign")
    none = tmp_path / "none"
    assert str(none) in fails(capsys, *train, none, "--resume")
    changed = fails(capsys, *train, run, "--resume", "--discount", "0.9")
    assert "--discount" in changed
    assert str(none) in fails(capsys, "evaluate", none)
    assert "3" in fails(capsys, "evaluate", run, "--stage", "3")
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_a_damaged_run(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    newest = checkpoint.available(copy / "checkpoints")[0]
    for file in newest.rglob("*"):
        if file.is_file() and file.parent != newest:
            file.write_bytes(file.read_bytes()[:-1])
    assert newest.name in fails(capsys, "evaluate", copy)
    (copy / HEADER).write_text("{")
    assert str(copy) in fails(capsys, "evaluate", copy)
    (copy / HEADER).write_text('{"format": 0}')
    assert str(copy) in fails(capsys, "evaluate", copy)


def test_resuming_what_is_finished_changes_nothing(run: Path) -> None:
    results = (run / "results.jsonl").read_bytes()
    main.main(["train", "probe/reach", "--out", str(run), *TINY, "--resume"])
    assert (run / "results.jsonl").read_bytes() == results


def test_evaluate(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main.main(["evaluate", str(run), "--episodes", "3", "--json"])
    row = json.loads(capsys.readouterr().out)
    assert row["steps"] == 3 * 20
    main.main(["evaluate", str(run), "--episodes", "3"])
    assert f"{row['return']:.1f}" in capsys.readouterr().out


def test_evaluate_without_task_labels(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", str(run), "--episodes", "3", "--task-label", "none"]
    main.main([*words, "--json"])
    row = json.loads(capsys.readouterr().out)
    chosen = row["chosen"]
    assert chosen["return"] == row["return"]
    assert (chosen["interactions"], chosen["candidates"]) == (0, 1)
    main.main(words)
    assert "nothing to choose" in capsys.readouterr().out
    assert "--trials" in fails(capsys, *words, "--trials", "0")
    assert "--trial-steps" in fails(capsys, *words, "--trial-steps", "21")


def test_report(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    out = tmp_path / "report"
    main.main(["report", str(run), "--out", str(out)])
    shown = capsys.readouterr().out
    assert "FT-1" in shown
    for name in ("report.md", "report.csv", "result.json", "tradeoff.png"):
        assert (out / name).stat().st_size > 0
        assert str(out / name) in shown
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_report_of_success_rates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_cw(tmp_path / "run")
    single = [str(write_alone(tmp_path / t, t, [0, 0, 0])) for t in TRIPLET]
    words = ["report", str(run), "--out", str(tmp_path / "out")]
    main.main([*words, "--success", "last", "--single", *single])
    shown = capsys.readouterr().out
    # Half of (0.4 + 0.5 + 0.7) / 3 and of what the second seed solves above it.
    assert "0.29 ± 0.04" in shown
    assert "AUC_b" in shown
    assert TRIPLET[1] in fails(capsys, *words, "--single", single[0])
    assert "--success" in fails(capsys, *words, "--success", "first")


def test_reports_that_cannot_be(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fails(capsys, "report")
    assert str(run) in fails(capsys, "report", run, run)
    assert str(tmp_path) in fails(capsys, "report", tmp_path)
    assert "--oot" in fails(capsys, "report", run, "--oot", tmp_path)
    file = tmp_path / "file"
    file.touch()
    assert str(file) in fails(capsys, "report", run, "--out", file)


def test_list_and_info(capsys: pytest.CaptureFixture[str]) -> None:
    main.main(["list", "--json"])
    names = json.loads(capsys.readouterr().out)
    assert {"ant/transfer", "humanoid/hard"} <= set(names["scenarios"])
    assert {"rewire", "ft1"} <= set(names["methods"])
    main.main(["list"])
    assert "halfcheetah/robustness" in capsys.readouterr().out
    main.main(["info", "probe/reach", "--json"])
    facts = json.loads(capsys.readouterr().out)
    assert facts["interactions"] == 10_000
    assert [len(task["action_scale"]) for task in facts["tasks"]] == [2] * 4
    assert facts["model_size"]["ft1"] == 1
    assert 2 < facts["model_size"]["rewire"] < 2.2
    main.main(["info", "probe/reach"])
    assert "probe/reach" in capsys.readouterr().out


def test_help_names_the_settings_and_their_values(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main.main(["train", "probe/reach", "--help"])
    assert exit_.value.code == 0
    shown = capsys.readouterr().out
    for flag in ("--interactions", "--lr-policy", "--modes", "--beta", "--resume"):
        assert flag in shown


def test_nothing_is_imported_upward() -> None:
    # Every module of the package is loaded by now; none may wait for the command.
    assert "rewire_jax.cli.main" in sys.modules
    assert sorted(rewire_jax.__all__) == rewire_jax.__all__
    assert all(hasattr(rewire_jax, name) for name in rewire_jax.__all__)
