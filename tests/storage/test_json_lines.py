"""Tables of JSON lines; what reads runs has more on them."""

import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.storage import json_lines


def parse(row):
    return (int(row["a"]),), json_lines.number(row["b"])


def test_a_cut_line_counts_for_nothing(tmp_path):
    path = tmp_path / "t.jsonl"
    path.write_text('{"a": 0, "b": 1}\n{"a": 1, "b": 2}\n{"a": 2, ')
    assert json_lines.table(path, parse) == {(0,): 1.0, (1,): 2.0}


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ('{"a": "x", "b": 1}', "'x'"),
        ('{"a": 0, "b": 1}', "line 1"),
        ('{"a": 0}', "no 'b'"),
        ('{"a": 0, ', "Expecting"),
    ],
)
def test_a_damaged_row_is_named(tmp_path, line, why):
    path = tmp_path / "t.jsonl"
    path.write_text(f'{{"a": 0, "b": null}}\n{line}\n')
    with pytest.raises(UserError, match=f"line 2 is damaged .*{why}"):
        json_lines.table(path, parse)


def test_a_missing_file_is_an_empty_table_only_where_it_may_be(tmp_path):
    path = tmp_path / "t.jsonl"
    assert json_lines.table(path, parse, needed=False) == {}
    with pytest.raises(UserError, match=r"t\.jsonl is missing"):
        json_lines.table(path, parse)
