"""The command in the process of a test: words for a run of seconds, and its errors."""

import pytest

from rewire_jax.cli import main

TRAIN = (
    "--method ft1 --profile quick --tasks 1 --interactions 320 --envs 16 --updates 1"
    " --warmup 160 --eval-episodes 2 --report-every 160 --checkpoint-every 0"
    " --depth 1 --hidden 8 --batch-size 8"
)
TINY = TRAIN.split()


def fails(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The message with which `rewire-jax` refuses these words, a line."""
    with pytest.raises(SystemExit) as exit_:
        main.main([str(word) for word in words])
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    return error
