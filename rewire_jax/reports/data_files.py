"""Numbers as CSV and JSON."""

import csv
import io
import json
import math
from collections.abc import Sequence
from typing import Any


def csv_text(
    rows: Sequence[dict[str, Any]], columns: Sequence[str] | None = None
) -> str:
    """CSV of rows that all have the same columns; None and NaN are left empty.

    Args:
        rows: values by column.
        columns: needed where there may be no rows.
    """
    file = io.StringIO()
    writer = csv.DictWriter(file, columns or list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(_without_nan(rows))
    return file.getvalue()


def json_text(data: Any) -> str:
    """JSON, with null for what is not finite."""
    return json.dumps(_without_nan(data), indent=1, allow_nan=False) + "\n"


def _without_nan(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _without_nan(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_without_nan(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
