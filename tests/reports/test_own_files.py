"""A report replaces an older one, and nothing else."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
from fake_run import write_run

from rewire_jax.core.errors import UserError
from rewire_jax.reports.report import Report
from rewire_jax.reports.table import Table


def report(folder: Path, value: int = 1) -> Report[int]:
    return Report(
        folder=folder,
        name="report.md",
        title=f"Report {value}",
        notes=(),
        numbers=value,
        table=Table(["a"], [[str(value)]]),
        shown=(),
        reading=(),
        texts={"a.csv": f"a\n{value}\n"},
        pictures={"a.png": "A"},
        draw=lambda place: (place / "a.png").write_bytes(bytes([value])) and None,
        details=[],
        origins=[],
    )


def held(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_older_report_is_replaced(tmp_path: Path) -> None:
    report(tmp_path, 1).write()
    report(tmp_path, 2).write()
    found = held(tmp_path)
    assert found["a.csv"] == b"a\n2\n"
    assert found["a.png"] == b"\2"
    assert b"Report 2" in found["report.md"]
    assert set(found) == {"report.md", "a.csv", "a.png"}


def write_note(folder: Path) -> None:
    (folder / "report.md").write_text("# My notes\n")


def edit_page(folder: Path) -> None:
    page = folder / "report.md"
    page.write_text(page.read_text().replace("# Report", "# My report"))


def append_to_page(folder: Path) -> None:
    with (folder / "report.md").open("a") as file:
        file.write("My notes.\n")


def draw_another(folder: Path) -> None:
    (folder / "a.png").write_bytes(b"mine")


def delete_page(folder: Path) -> None:
    (folder / "report.md").unlink()


def link_away(folder: Path) -> None:
    (folder / "a.csv").unlink()
    (folder / "a.csv").symlink_to(folder / "nowhere")


def files(folder: Path) -> dict[str, tuple[int, ...]]:
    """All that the system knows of the files, but when they were read."""
    found = {path.name: path.lstat() for path in folder.iterdir()}
    return {
        name: (*stat[:7], stat.st_mtime_ns, stat.st_ctime_ns)
        for name, stat in found.items()
    }


CHANGES = (write_note, edit_page, append_to_page, draw_another, delete_page, link_away)


@pytest.mark.parametrize("change", CHANGES)
def test_what_no_report_wrote_stays(
    tmp_path: Path, change: Callable[[Path], None]
) -> None:
    report(tmp_path, 1).write()
    change(tmp_path)
    before = files(tmp_path)
    with pytest.raises(UserError, match=str(tmp_path)):
        report(tmp_path, 2).write()
    assert files(tmp_path) == before


def test_the_same_files_of_an_interrupted_report_are_no_hindrance(
    tmp_path: Path,
) -> None:
    report(tmp_path, 1).write()
    (tmp_path / "report.md").unlink()
    report(tmp_path, 1).write()
    assert b"Report 1" in held(tmp_path)["report.md"]


def test_a_report_that_cannot_be_finished_leaves_the_older_one(tmp_path: Path) -> None:
    report(tmp_path, 1).write()
    before = held(tmp_path)

    def fail(place: Path) -> None:
        (place / "a.png").write_bytes(b"half")
        raise OSError(28, "No space left on device", str(place / "a.png"))

    with pytest.raises(UserError, match="space"):
        dataclasses.replace(report(tmp_path, 2), draw=fail).write()
    assert held(tmp_path) == before


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_report_that_was_killed_between_two_files_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moved: int
) -> None:
    report(tmp_path, 1).write()
    left, move = [None] * moved, Path.replace

    def kill(path: Path, target: Path) -> Path:
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return move(path, target)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", kill)
        with pytest.raises(KeyboardInterrupt):
            report(tmp_path, 2).write()
    report(tmp_path, 3).write()
    assert held(tmp_path)["a.csv"] == b"a\n3\n"
    # An edited file is still not replaced.
    draw_another(tmp_path)
    with pytest.raises(UserError):
        report(tmp_path, 4).write()


def test_a_report_of_an_older_version_is_replaced(tmp_path: Path) -> None:
    report(tmp_path, 1).write()
    page = tmp_path / "report.md"
    page.write_text(page.read_text().replace('["', '"').replace('"]', '"'))
    report(tmp_path, 2).write()
    assert held(tmp_path)["a.csv"] == b"a\n2\n"


def test_a_run_s_report_is_written_again_over_itself(tmp_path: Path) -> None:
    from rewire_jax.reports.write import write_report

    run = write_run(tmp_path / "run", stages=1)
    first = write_report([run], tmp_path / "out")
    before = held(tmp_path / "out")
    second = write_report([run], tmp_path / "out")
    assert first.paths == second.paths
    assert held(tmp_path / "out") == before
