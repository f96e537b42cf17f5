import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.follow_readme import Done, chosen, follow, newcomer, sections
from rewire_jax.core.errors import UserError

ROOT = Path(__file__).parents[2]
ADDRESS = "https://example.org/theirs.git"
PAGE = f"""# Title

```sh
git clone {ADDRESS}
cd theirs
```

## First steps

It is in `runs/a/file`, never in `runs/b/`; `other/name` is none of these.

```sh
# Not a heading
mkdir -p runs/a .venv/bin
cat told >runs/a/file
ln -s {sys.executable} .venv/bin/python
```

```python
from pathlib import Path

print(Path("runs/a/file").read_text())
```

**For later.** It takes
days:

```sh
touch later
```

## Mistakes

```sh
false
touch after
```

```sh
touch next
echo "$HOME ${{VIRTUAL_ENV-none}} ${{PYTHONPATH-none}}" >home
```
"""


def test_a_page_is_taken_apart_into_what_is_to_be_run() -> None:
    title, first, mistakes = sections(PAGE)
    assert [s.title for s in (title, first, mistakes)] == [
        "Title",
        "First steps",
        "Mistakes",
    ]
    assert title.blocks == [("sh", f"git clone {ADDRESS}\ncd theirs\n")]
    assert [language for language, _ in first.blocks] == ["sh", "python"]
    assert first.told == ["runs/a/file", "runs/b/"]
    assert not any("later" in code for s in sections(PAGE) for _, code in s.blocks)


def test_sections_are_chosen_by_how_their_titles_begin() -> None:
    def titles(only=(), skip=()):
        return [section.title for section in chosen(sections(PAGE), only, skip)]

    assert titles() == ["Title", "First steps", "Mistakes"]
    assert titles(only=("Fi",)) == ["First steps"]
    assert titles(only=("Fi", "Mi"), skip=("First",)) == ["Mistakes"]
    with pytest.raises(UserError, match=r"Last.*Title, First steps, Mistakes"):
        titles(skip=("Last",))


def test_blocks_are_run_as_they_stand_and_what_fails_is_told(
    tmp_path: Path, monkeypatch
) -> None:
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    git = ["git", "-c", "user.name=A", "-c", "user.email=a@example.org", "-C", theirs]
    (theirs / "told").write_text("by the clone")
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "All"]):
        subprocess.run([*git, *words], check=True)
    monkeypatch.setenv("VIRTUAL_ENV", "/some/where")
    monkeypatch.setenv("PYTHONPATH", "/some/where")

    folder = tmp_path / "new comer"
    environment = newcomer(folder, {ADDRESS: theirs})
    assert str(Path(sys.executable).parent) not in environment["PATH"].split(os.pathsep)
    done = list(follow(sections(PAGE), folder, environment, ".venv/bin/python"))
    assert [each._replace(seconds=None) for each in done] == [
        Done("Title", f"git clone {ADDRESS}", True, 0),
        Done("First steps", "# Not a heading", True, 0),
        Done("First steps", "from pathlib import Path", True, 0),
        Done("First steps", "runs/a/file is there", True),
        Done("First steps", "runs/b/ is there", False),
        Done("Mistakes", "false", False, 1),
        Done("Mistakes", "touch next", True, 0),
    ]
    clone = folder / "here" / "theirs"
    assert (clone / "runs/a/file").read_text() == "by the clone"
    assert (clone / "home").read_text() == f"{folder / 'home'} none none\n"
    assert (clone / "next").exists()
    assert not (clone / "after").exists()
    assert not (clone / "later").exists()
    # The same folder is gone on with, in the place where it was left.
    more = sections("```sh\ntouch again\n```\n")
    (again,) = follow(more, folder, environment, "none")
    assert again.well
    assert (clone / "again").exists()


def test_the_readme_gives_a_newcomer_the_two_commands_and_no_unknown_blocks() -> None:
    text = (ROOT / "README.md").read_text()
    assert text.count("`.venv/bin/python FILE`") == 1
    found = sections(text)
    blocks = [block for section in found for block in section.blocks]
    assert {language for language, _ in blocks} == {"sh", "python"}
    assert [code for _, code in blocks if code.startswith("make")] == [
        "make bench-brax\n",
        "make test\n",
    ]
    assert blocks[0][1].startswith("git clone https://")
