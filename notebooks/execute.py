"""Executes the notebooks in place; `make notebooks` does.

What is written depends on the cells and on what they compute: it has no times, no
machine, and nothing from the standard error output, where progress is shown. So another
execution makes a small difference.
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
    """A notebook after all its cells were executed.

    Args:
      path: of the notebook, which stays as it is.
      folder: where it runs, and leaves what it makes.

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
    """The notebook without what differs from one execution to the next."""
    notebook.metadata = nbformat.from_dict(_METADATA)
    for place, cell in enumerate(notebook.cells):
        cell.id = f"{place:02d}"
        cell.metadata = NotebookNode()
        if cell.cell_type == "code":
            cell.outputs = [x for x in cell.outputs if x.get("name") != "stderr"]
    return notebook


def main(paths: Sequence[str]) -> None:
    """Executes these notebooks, or all, each in an empty folder."""
    for path in map(Path, paths or sorted(map(str, FOLDER.glob("*.ipynb")))):
        print(path, file=sys.stderr)
        with TemporaryDirectory() as folder:
            notebook = execute(path, Path(folder))
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main(sys.argv[1:])
