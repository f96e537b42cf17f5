"""The notebooks as pages, with the outputs that are committed."""

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent


def write(folder: Path) -> list[Path]:
    """Writes a page of Markdown for each, and its pictures; returns the pages."""
    folder.mkdir(parents=True, exist_ok=True)
    pages = []
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        title, *cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        link = f"{{download}}`The notebook <../../notebooks/{path.name}>`, executed."
        parts = ["".join(title["source"]), link]
        for place, cell in enumerate(cells):
            parts += _cell(cell, folder / f"{path.stem}-{place}.png")
        pages.append(folder / f"{path.stem}.md")
        pages[-1].write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return pages


def _cell(cell: dict[str, Any], picture: Path) -> Iterator[str]:
    """A cell and what it gave, in Markdown; a picture goes into its file."""
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        yield source
        return
    yield f"```python\n{source}\n```"
    for output in cell["outputs"]:
        data = output.get("data", {"text/plain": output.get("text", "")})
        if "image/png" in data:
            picture.write_bytes(base64.b64decode("".join(data["image/png"])))
            yield f"![What this cell draws]({picture.name})"
        else:
            yield f"```text\n{''.join(data['text/plain']).rstrip()}\n```"
