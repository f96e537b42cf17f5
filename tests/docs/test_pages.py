"""The code in the pages: Python blocks run, and shell blocks name what there is."""

import dataclasses
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sybil import Sybil
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser

import rewire_jax
from rewire_jax.cli import main
from rewire_jax.envs import scenarios
from rewire_jax.methods import METHODS
from tests.tiny import small, tiny

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
PYTHON = Sybil([PythonCodeBlockParser()])
SHELL = Sybil([CodeBlockParser("sh", lambda example: None)])
RUN = "runs/rewire"


def pages(sybil: Sybil) -> list[str]:
    """The pages with blocks of a language, by their paths in the repository."""
    found = [page for page in PAGES if list(sybil.parse(page).examples())]
    return sorted(str(page.relative_to(ROOT)) for page in found)


def execute(page: str) -> None:
    """Runs the Python blocks of a page, one after the other in one namespace."""
    for example in PYTHON.parse(ROOT / page).examples():
        example.evaluate()


def shrunk(run: Callable[..., Any]) -> Callable[..., Any]:
    """`train`, `sweep` or `make_train` with budgets of seconds."""
    return lambda settings, *rest, **more: run(small(settings), *rest, **more)


@pytest.fixture
def newcomer(tmp_path: Path, monkeypatch):
    """An empty folder, training of seconds, and registries that are restored."""
    monkeypatch.chdir(tmp_path)
    preset = rewire_jax.preset
    monkeypatch.setattr(rewire_jax, "preset", lambda *args: small(preset(*args)))
    monkeypatch.setattr(rewire_jax, "train", shrunk(rewire_jax.train))
    monkeypatch.setattr(rewire_jax, "sweep", shrunk(rewire_jax.sweep))
    monkeypatch.setattr(rewire_jax, "make_train", shrunk(rewire_jax.make_train))
    with (
        mock.patch.dict(scenarios.DOMAINS),
        mock.patch.dict(scenarios.SCENARIOS),
        mock.patch.dict(METHODS),
    ):
        yield tmp_path


def test_a_method_and_a_domain_of_ones_own_train(newcomer: Path) -> None:
    execute("docs/extend.md")
    scenario = rewire_jax.make_scenario("corridor/ends")
    task = scenario.tasks[2].data
    state = scenario.environment.reset(task, jax.random.key(0))
    moved = scenario.environment.step(task, state, jnp.ones(1))
    expected = np.clip(state.inner - 0.1, -1, 1)
    np.testing.assert_allclose(moved.observation, expected, rtol=1e-6)
    np.testing.assert_allclose(moved.reward, -abs(0.8 - expected[0]), rtol=1e-6)

    settings = dataclasses.replace(tiny(scenario, "shrink"), tasks=2, seeds=1)
    rewire_jax.train(settings, newcomer / "run", scenario=scenario)
    policy = rewire_jax.load_policy(newcomer / "run", task=1)
    assert policy(jnp.zeros(1)).shape == (1,)
    assert len(rewire_jax.make_scenario("halfcheetah/slippery").tasks) == 4


@pytest.mark.parametrize("page", pages(PYTHON))
def test_python_blocks_can_be_compiled(page: str) -> None:
    for example in PYTHON.parse(ROOT / page).examples():
        compile(example.parsed, f"{page}:{example.line}", "exec")


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in pages(PYTHON) if page != "docs/extend.md"]
)
def test_python_blocks_run(newcomer: Path, page: str) -> None:
    if RUN in (ROOT / page).read_text():  # The README trains it by a command.
        settings = tiny("halfcheetah/forgetting")
        settings = dataclasses.replace(settings, tasks=2, seeds=1)
        rewire_jax.train(settings, RUN)
    execute(page)


def commands(page: str) -> list[list[str]]:
    """The words of each line in the shell blocks of a page."""
    text = "\n".join(example.parsed for example in SHELL.parse(ROOT / page).examples())
    lines = text.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


@pytest.mark.parametrize("page", pages(SHELL))
def test_shell_blocks_name_what_there_is(page: str, capsys) -> None:
    targets = (ROOT / "Makefile").read_text()
    for words in commands(page):
        program, *rest = words
        if program == "make":
            assert re.search(rf"^{rest[0]}:.*## ", targets, re.M), words
            for variable in rest[1:]:
                assert f"$({variable.partition('=')[0]})" in targets, words
        elif Path(program).name == "rewire-jax":
            check_command(rest, capsys)
        elif rest[:1] == ["-m"] and rest[1].startswith("experiments."):
            assert (ROOT / rest[1].replace(".", "/")).with_suffix(".py").exists()
        else:
            assert Path(program).name in ("cd", "git", "jupyter", "pip", "python")


def check_command(words: list[str], capsys) -> None:
    """The command's own help names every flag, and a scenario is one there is."""
    command, *rest = words
    asked = [command]
    if command in ("train", "sweep"):
        rewire_jax.make_scenario(rest[0])
        method = rest[rest.index("--method") + 1] if "--method" in rest else "rewire"
        asked += [rest[0], "--method", method]
    with pytest.raises(SystemExit) as end:
        main.main([*asked, "--help"])
    assert end.value.code == 0
    told = capsys.readouterr().out
    for flag in [word for word in rest if re.match("--[a-z]", word)]:
        assert re.search(rf"{flag}(?![\w-])", told), words


def test_the_readme_gives_two_commands() -> None:
    words = commands("README.md")
    assert words[0][:2] == ["git", "clone"]
    assert [each for each in words if each[0] == "make"] == [
        ["make", "setup"],
        ["make", "bench-brax"],
        ["make", "test"],
    ]
