from rewire_jax.reports.table import to_markdown


def test_numbers_are_set_to_the_right_and_bars_are_no_columns():
    heads = ["name", "of", "size", "note"]
    rows = [["a|b", "1 of 2", "–", "12 heads"], ["c", "1.0 ± 0.1", "5 ms", "3"]]
    assert to_markdown(heads, rows) == [
        "| name | of | size | note |",
        "| --- | ---: | ---: | --- |",
        r"| a\|b | 1 of 2 | – | 12 heads |",
        "| c | 1.0 ± 0.1 | 5 ms | 3 |",
        "",
    ]
