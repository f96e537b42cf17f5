import re
from pathlib import Path

import pytest

from experiments import readme
from experiments.readme import fill
from rewire_jax.core.errors import UserError

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results"
TABLE = "| a | bc d | e |\n|---|---|---|\n| 1 | 2 | 3 |\n"


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "results"
    (folder / "one").mkdir(parents=True)
    (folder / "one" / "report.md").write_text(
        f"# Title\n\n**Note.**\n\n{TABLE}\n![curves](curves.png)\n\n## Part\n\n"
        f"[a page](https://example.org)\n\n{TABLE}"
    )
    (folder / "two.md").write_text("# Two\n\ntext\n")
    return folder


def test_blocks_are_filled_from_results_and_nothing_else_changes(
    tmp_path: Path, results: Path
) -> None:
    text = (
        "# Page\n\n## Section\n\nbefore\n<!-- results: one -->\nold\n<!-- end -->\n"
        "between\n```sh\n# a comment\n```\n<!-- results: two -->\n<!-- end -->\nafter\n"
    )
    page = tmp_path / "docs" / "page.md"
    filled = fill(text, page, results)
    assert "old" not in filled
    assert "![curves](../results/one/curves.png)" in filled
    assert "[a page](https://example.org)" in filled
    # Headings are one level below the section's, in the second block as in the first.
    assert re.findall(r"^#+ .*$", filled, re.M) == [
        "# Page",
        "## Section",
        "### Title",
        "#### Part",
        "# a comment",
        "### Two",
    ]
    assert fill(filled, page, results) == filled
    left = re.sub(r"(?s)<!-- results.*?end -->\n", "", filled)
    assert left == re.sub(r"(?s)<!-- results.*?end -->\n", "", text)
    with pytest.raises(UserError, match=r"page\.md names three"):
        fill("<!-- results: three -->\n<!-- end -->\n", page, results)


def test_some_columns_of_the_first_table_are_taken_by_how_they_begin(
    results: Path,
) -> None:
    text = "<!-- results: one | e | bc -->\n<!-- end -->\n"
    filled = fill(text, Path("page.md"), results)
    assert filled == (
        "<!-- results: one | e | bc -->\n\n# Title\n\n"
        "| e | bc d |\n| ---: | ---: |\n| 3 | 2 |\n\n<!-- end -->\n"
    )
    with pytest.raises(UserError, match=r"one has no column .* 'f'"):
        fill(text.replace("bc", "f"), Path("page.md"), results)


@pytest.mark.parametrize("page", readme.PAGES, ids=str)
def test_pages_are_up_to_date(page: Path) -> None:
    text = (ROOT / page).read_text()
    assert fill(text, ROOT / page, RESULTS) == text


def test_every_committed_result_is_shown() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    text = "".join(page.read_text() for page in pages)
    shown = re.findall(r"<!-- (?:made: )?results:? ([^\s/]+)", text)
    there = {path.name.partition(".")[0] for path in RESULTS.iterdir()}
    # What the pages ask for by `made` may be committed later.
    assert there <= set(shown)


def test_links_of_the_readme_lead_somewhere() -> None:
    text = (ROOT / "README.md").read_text()
    links = [re.split("#", link) for link in re.findall(r"\]\((.*?)\)", text)]
    assert len(links) > 20
    for path, *anchor in links:
        assert (ROOT / path).exists(), path
        if anchor:
            heads = re.findall(r"^#+ (.*)", (ROOT / path).read_text(), re.M)
            # As GitHub and the documentation name them.
            slugs = [
                re.sub(r"[^\w\s-]", "", h).lower().replace(" ", "-") for h in heads
            ]
            assert anchor[0] in slugs
