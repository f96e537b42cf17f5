"""Executes the notebooks in place; `make notebooks` does.

The saved outputs hold no times, no machine names, and nothing from standard error,
which shows progress. So a new execution changes the files only a little.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).resolve().parent
_METADATA = {
    "kernelspec": {
        "display_name": "Python 3",
        "language": "python",
        "name": "python3",
    },
    "language_info": {"name": "python"},
}
_LIMIT = 600  # seconds a cell


def execute(path: Path, folder: Path) -> NotebookNode:
    """Executes all cells of a notebook and returns it.

    Args:
      path: of the notebook; the file does not change.
      folder: working directory of the cells.

    Raises:
      nbclient.exceptions.CellExecutionError: a cell failed.
    """
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(
        notebook,
        timeout=_LIMIT,
        coalesce_streams=True,
        record_timing=False,
        resources={"metadata": {"path": str(folder)}},
    ).execute()
    return normalised(notebook)


def normalised(notebook: NotebookNode) -> NotebookNode:
    """The notebook without the parts that differ between executions."""
    notebook.metadata = nbformat.from_dict(_METADATA)
    for place, cell in enumerate(notebook.cells):
        cell.id = f"{place:02d}"
        cell.metadata = NotebookNode()
        if cell.cell_type == "code":
            cell.outputs = [x for x in cell.outputs if x.get("name") != "stderr"]
    return notebook


def main(paths: Sequence[str]) -> None:
    """Executes these notebooks, or all if none is given, each in an empty folder."""
    for path in map(Path, paths or sorted(map(str, FOLDER.glob("*.ipynb")))):
        print(path, file=sys.stderr)
        with TemporaryDirectory() as folder:
            notebook = execute(path, Path(folder))
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main(sys.argv[1:])
