"""Sweeps that cannot be, and what is said of them."""

from pathlib import Path

import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.storage import run_folder
from tests.command_line import fails
from tests.small_sweep import run_sweep, small


def test_there_must_be_a_sweep_to_join(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no sweep"):
        run_sweep(tmp_path / "none", small(), axes={"beta": [1, 2]}, join=True)


def test_settings_that_make_no_sense_are_said(tmp_path: Path) -> None:
    for options, said in (
        ({}, "needs an axis"),
        ({"axes": {"beta": [1]}, "halving": 0}, "--halving"),
        ({"axes": {"beta": [1]}, "random": -1}, "--random"),
        ({"axes": {"beta": [1]}, "members_per_batch": -1}, "--members-per-batch"),
        ({"axes": {"beta": [1]}, "random": 2}, "1 of the configurations are the same"),
        ({"configurations": [{"beta": 1}, {"alpha": 1}]}, "the same settings"),
        ({"axes": {"hidden": [1]}}, "no sweep over 'hidden'"),
        ({"axes": {"beta": np.array([1, 1])}}, "1 of the configurations are the same"),
    ):
        with pytest.raises(UserError, match=said):
            run_sweep(tmp_path / "none", small(), **options)
    assert not (tmp_path / "none").exists()


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "sweep").touch()
    with pytest.raises(UserError, match=r"cannot write to .*task-000: Not a directory"):
        run_folder.make(tmp_path / "sweep" / "task-000")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--axis", "beta"], "--axis"),
        (["--axis", "beta", "1", "--beta", "2"], "beta is an axis twice"),
        (["--axis", "beta", "one"], "--axis"),
        (["--modes", "1.5"], "--modes must be a whole number"),
        (["--modes", "inf"], "--modes must be finite"),
        (["--random", "2", "--beta", "1", "nan"], "--beta must be finite"),
        (["--random", "2", "--modes", "1.5", "4"], "--modes must be a whole number"),
        (["--beta", "1", "--beta", "2"], "beta is an axis twice"),
        (["--beta", "1", "--processes", "2"], "--processes"),
        (["--axis", "tau", "0"], "--tau must be above 0"),
        (["--random", "3", "--beta", "1", "2", "3"], "needs a range"),
        (["--method", "ft1", "--alpha", "1"], "no sweep over 'alpha'"),
        (["--beta", "1", "--resume"], "holds no sweep"),
    ],
)
def test_wrong_arguments_end_in_one_line(
    words: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = str(tmp_path / "sweep")
    assert said in fails(capsys, "sweep", "probe/reach", *words, "--out", out)
    assert not (tmp_path / "sweep").exists()
