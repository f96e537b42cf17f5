"""How Sphinx builds the documentation; `make docs` does.

Nothing is fetched, neither to build it nor to read it.
"""

import shutil
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # for docs and experiments

from docs import made  # noqa: E402

project = "rewire_jax"
author = "the authors of rewire_jax"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
smartquotes = False  # They would make a dash of a flag's hyphens.
default_role = "code"  # Docstrings quote code by single backticks.
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
nb_execution_mode = "off"  # Pages show the outputs that are committed.

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
add_module_names = False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # The signature has them.
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True

html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_title = "rewire_jax"
html_copy_source = False
html_show_copyright = False


def _skip(app: Any, what: str, name: str, each: Any, skip: bool, options: Any) -> bool:
    """Leaves out the fields of named tuples, which their class has described."""
    return skip or (each.__doc__ or "").startswith("Alias for field number")


def _fields(app: Any, what: str, name: str, each: Any, *rest: Any) -> Any:
    """Leaves out a named tuple's signature, too: functions as defaults fill pages."""
    return ("", None) if hasattr(each, "_fields") else None


def _prepare(app: Any) -> None:
    """Copies the notebooks to where Sphinx looks for pages."""
    # Anew: pages of an earlier version would stand beside the copies.
    shutil.rmtree(ROOT / "docs/notebooks", ignore_errors=True)
    (ROOT / "docs/notebooks").mkdir()
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        shutil.copy(path, ROOT / "docs/notebooks")


def setup(app: Any) -> None:
    """Registers what is done whenever the documentation is built."""
    app.connect("builder-inited", _prepare)
    app.connect("source-read", made.fill)
    app.connect("autodoc-skip-member", _skip)
    app.connect("autodoc-process-signature", _fields)
