import re
from pathlib import Path

import pytest

from experiments.readme import fill
from rewire_jax.errors import UserError
from tests.tiny import tiny

ROOT = Path(__file__).parent.parent


def test_blocks_are_filled_from_results_and_nothing_else_changes(
    tmp_path: Path,
) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "report.md").write_text("# Title\n\n![curves](curves.png)\n")
    (tmp_path / "two.md").write_text("| a |\n|---|\n")
    text = (
        "before\n<!-- results: one -->\nold\n<!-- end -->\nbetween\n"
        "<!-- results: two -->\n<!-- end -->\nafter\n"
    )
    filled = fill(text, tmp_path)
    assert "old" not in filled
    assert f"![curves]({tmp_path.as_posix()}/one/curves.png)" in filled
    assert "#### Title" in filled
    assert "| a |" in filled
    assert fill(filled, tmp_path) == filled
    assert re.sub(r"(?s)<!-- results.*?end -->\n", "", filled) == (
        "before\nbetween\nafter\n"
    )
    with pytest.raises(UserError, match="three"):
        fill("<!-- results: three -->\n<!-- end -->\n", tmp_path)


def test_the_readme_is_up_to_date() -> None:
    text = (ROOT / "README.md").read_text()
    assert (
        fill(text, ROOT / "experiments" / "results").replace(f"{ROOT.as_posix()}/", "")
        == text
    )


def test_the_readmes_own_scenario_and_method_work(tmp_path: Path) -> None:
    import dataclasses

    import jax.numpy as jnp

    import rewire_jax
    from rewire_jax import methods

    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    own = next(block for block in blocks if "ScenarioSpec(" in block)
    names: dict = {}
    # All but the training, which takes minutes.
    exec(own.split("train(dataclasses")[0], names)
    assert list(names["scenario"].tasks[1].action_scale).count(0) == 1
    assert names["settings"].interactions == 38_400
    blocks = re.findall(
        r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S
    )
    exec(next(block for block in blocks if "def shrink" in block), {})
    try:
        settings = dataclasses.replace(tiny(method="shrink"), tasks=2)
        rewire_jax.train(settings, tmp_path / "run")
        policy = rewire_jax.load_policy(tmp_path / "run", task=1)
        assert policy(jnp.zeros(2)).shape == (2,)
    finally:
        del methods.METHODS["shrink"]
