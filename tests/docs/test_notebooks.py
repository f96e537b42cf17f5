"""The notebooks: committed with outputs that another execution would give, too."""

import ast
import base64
import json
import re
import shutil
from io import BytesIO
from pathlib import Path

import nbformat
import pytest
from matplotlib.image import imread
from nbclient.exceptions import CellExecutionError

from notebooks import execute

PATHS = sorted(execute.FOLDER.glob("*.ipynb"))
MOST = 200_000  # bytes of outputs
# A path from the root, as of someone's home; not a fraction, nor part of an address.
ABSOLUTE = re.compile(r"(?<![\w./:~])/\w[\w.-]*/[\w./-]+")
BY_NAME = {"argvalues": PATHS, "ids": lambda path: path.stem}


def read(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, as_version=4)


def codes(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def texts(notebook: nbformat.NotebookNode) -> list[str]:
    """What the cells said, but for pictures."""
    return [
        output.get("text") or output["data"]["text/plain"]
        for cell in codes(notebook)
        for output in cell.outputs
    ]


def pictures(notebook: nbformat.NotebookNode) -> list[bytes]:
    return [
        base64.b64decode(output["data"]["image/png"])
        for cell in codes(notebook)
        for output in cell.outputs
        if "image/png" in output.get("data", {})
    ]


def words(notebook: nbformat.NotebookNode) -> list[str]:
    """What the cells said, its numbers and spaces left out."""
    number = r"[-+]?\d+(?:[.,]\d+)*\.?(?:e[-+]?\d+)?"
    return [re.sub(rf"{number}|\s+", "", text) for text in texts(notebook)]


def test_there_are_five() -> None:
    assert [path.stem for path in PATHS] == [
        "01_policies",
        "02_sweep",
        "03_your_own_method",
        "04_your_own_scenario",
        "05_permutation_layers",
    ]


@pytest.mark.parametrize("path", **BY_NAME)
def test_it_was_executed_in_order_and_says_nothing_of_the_machine(path: Path) -> None:
    notebook = read(path)
    nbformat.validate(notebook)
    code = codes(notebook)
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    kinds = {output.output_type for cell in code for output in cell.outputs}
    assert kinds <= {"stream", "execute_result", "display_data"}
    for text in [*texts(notebook), *(cell.source for cell in notebook.cells)]:
        assert not ABSOLUTE.search(text), text
        assert "Traceback" not in text
    assert execute.normalised(read(path)) == notebook
    written = nbformat.writes(notebook) + "\n"
    assert path.read_text(encoding="utf-8") == written


@pytest.mark.parametrize("path", **BY_NAME)
def test_it_is_small_explained_and_has_something_to_look_at(path: Path) -> None:
    notebook = read(path)
    outputs = [cell.outputs for cell in codes(notebook)]
    assert sum(len(json.dumps(output)) for output in outputs) < MOST
    assert notebook.cells[0].source.startswith("# ")
    # Text first.
    assert [cell.cell_type for cell in notebook.cells[:2]] == ["markdown", "code"]
    tree = ast.parse("\n".join(cell.source for cell in codes(notebook)))
    checks = [node for node in ast.walk(tree) if isinstance(node, ast.Assert)]
    assert checks
    for picture in pictures(notebook):
        assert imread(BytesIO(picture)).std() > 0.05
    assert pictures(notebook)


def test_paths_are_told_from_fractions_and_addresses() -> None:
    for text in ("/home/a/b", "in '/tmp/x/y.py'", "(/srv/runs/1)"):
        assert ABSOLUTE.search(text), text
    for text in ("runs/notebooks/x", "a / b", "https://a.org/b/c", "1/2"):
        assert not ABSOLUTE.search(text), text


@pytest.mark.slow
@pytest.mark.parametrize("path", **BY_NAME)
def test_it_runs_anywhere_and_gives_what_is_committed(
    path: Path, tmp_path: Path
) -> None:
    copy = shutil.copy(path, tmp_path)
    folder = tmp_path / "empty"
    folder.mkdir()
    again, committed = execute.execute(Path(copy), folder), read(path)
    assert words(again) == words(committed)
    assert len(pictures(again)) == len(pictures(committed))
    # All that it makes is under one folder that can be deleted.
    assert {each.name for each in folder.iterdir()} <= {"runs"}


@pytest.mark.slow
def test_a_cell_that_fails_is_an_error_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "wrong.ipynb"
    cell = nbformat.v4.new_code_cell("assert 1 + 1 == 3")
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), path)
    before = path.read_bytes()
    with pytest.raises(CellExecutionError, match="assert 1"):
        execute.main([str(path)])
    assert path.read_bytes() == before
