"""The live display, with a terminal and without one."""

import io

import pytest
from rich.console import Console

from rewire_jax.run.progress import Progress

TASKS = ("hugefoot", "moon")


def run(progress: Progress) -> None:
    """A short run as the training loop shows it."""
    with progress:
        progress.update(0, 1000, [None, 12.34], 0.4, None, "compiling")
        progress.update(1, 20_000, [1234.5, None], 5678.9, 3725.0)
        progress.message("seed 1 diverged [and is frozen]")
        progress.finish_task(1, [1500.2, float("nan")], 61.4)


def terminal() -> tuple[Console, io.StringIO]:
    file = io.StringIO()
    return Console(file=file, force_terminal=True, width=100, _environ={}), file


def test_quiet_without_a_terminal() -> None:
    file = io.StringIO()
    run(Progress(TASKS, 30_000, ["seed 0", "seed 1"], "rewire", file))
    assert file.getvalue() == (
        "seed 1 diverged [and is frozen]\n"
        "rewire: task 2 of 2, moon finished in 0:01:01, "
        "return seed 0: 1,500  seed 1: –\n"
    )


def test_goes_to_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    run(Progress(TASKS, 30_000, ["seed 0", "seed 1"], "rewire"))
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "task 2 of 2, moon finished" in captured.err


def test_a_notebook_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    run(Progress(TASKS, 30_000, ["seed 0", "seed 1"], "rewire"))
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 2


def test_dumb_terminal_is_quiet() -> None:
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, _environ={"TERM": "dumb"})
    run(Progress(TASKS, 30_000, ["seed 0", "seed 1"], "rewire", console=console))
    assert len(file.getvalue().splitlines()) == 2
    assert "\x1b" not in file.getvalue()


def test_live_display_shows_all_fields() -> None:
    console, file = terminal()
    run(
        Progress(
            TASKS,
            30_000,
            ["seed 3", "seed 4"],
            "rewire on ant/transfer",
            console=console,
        )
    )
    text = file.getvalue()
    for part in (
        "rewire on ant/transfer",
        "task 1 of 2, hugefoot",
        "1,000 / 30,000 interactions",
        "seed 3: –  seed 4: 12.3",
        "compiling",
        "task 2 of 2, moon",
        "20,000 / 30,000 interactions",
        "seed 3: 1,234  seed 4: –",
        "5,679 interactions/s",
        "1:02:05 left",
        "seed 1 diverged [and is frozen]",
        "finished in 0:01:01",
    ):
        assert part in text
    # The cursor is hidden meanwhile, and given back.
    assert text.count("\x1b[?25l") == text.count("\x1b[?25h") == 1


def test_many_seeds_are_abbreviated() -> None:
    console, file = terminal()
    with Progress(
        TASKS, 100, [f"seed {i}" for i in range(8)], "ft1", console=console
    ) as progress:
        progress.update(0, 10, [None] * 8, 1.0)
        progress.update(0, 20, [100.0, 300.0, None, *[200.0] * 5], 1.0)
    assert "mean 200, 100 to 300 in 7 members, none in 1" in file.getvalue()
    assert "seed 0" not in file.getvalue()


def test_display_ends_with_an_error() -> None:
    console, file = terminal()
    progress = Progress(TASKS, 100, ["seed 0"], "ft1", console=console)
    with pytest.raises(KeyboardInterrupt), progress:
        raise KeyboardInterrupt
    assert file.getvalue().count("\x1b[?25h") == 1
    progress.update(0, 1, [None], 1.0)  # a late one has nothing to show and no harm
