"""Run folders whose header was changed after training."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

Header = dict[str, Any]


def changed(folder: Path, out: Path, change: Callable[[Header], Any]) -> Path:
    """A copy with another header."""
    shutil.copytree(folder, out)
    path = out / "settings.json"
    header = json.loads(path.read_text())
    change(header)
    path.write_text(json.dumps(header))
    return out
