import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rewire_jax
from docs import drawings
from rewire_jax.cli import main
from rewire_jax.cli.commands import COMMANDS
from rewire_jax.methods import METHODS
from tests.tiny import tiny

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The pages by name, built with warnings as errors, links between them checked."""
    folder = tmp_path_factory.mktemp("docs")
    words = ["--fail-on-warning", "--keep-going", "--quiet", "--fresh-env"]
    out = folder / "site"
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", *words, "-d", folder, ROOT / "docs", out],
        capture_output=True,
        text=True,
        cwd=folder,
    )
    assert built.returncode == 0, built.stderr
    return {path.stem: path.read_text() for path in out.rglob("*.html")}


def codes(page):
    """What a page has as code, its tags taken away."""
    found = re.findall(r"<code.*?>(.*?)</code>", page, re.S)
    return {re.sub(r"<.*?>", "", code) for code in found}


def flags(capsys, *arguments):
    """The flags that a command's own help tells of."""
    with pytest.raises(SystemExit):
        main.main([*arguments, "--help"])
    told = set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", capsys.readouterr().out))
    # A scenario goes by its place.
    told -= {"--help", "--scenario"}
    return {flag for flag in told if not flag.startswith("--no-")}


def test_every_command_and_its_arguments_are_told(site, capsys) -> None:
    page, known = site["commands"], codes(site["commands"]) | codes(site["settings"])
    shared = flags(capsys)
    assert "--cache" in shared
    for flag in shared:
        assert flag in page
    for command in COMMANDS:
        assert any(code.startswith(f"rewire-jax {command}") for code in codes(page))
        place = ["probe/reach"] if command in ("train", "sweep") else []
        assert flags(capsys, command, *place) - shared <= known


def test_every_setting_of_every_method_is_told(site, capsys) -> None:
    known = codes(site["settings"])
    for method in METHODS:
        assert method in known
        own = flags(capsys, "train", "probe/reach", "--method", method)
        own -= flags(capsys, "list")
        assert len(own) > 30
        assert own - {"--out", "--resume", "--log"} <= known


def test_the_whole_public_face_is_told(site) -> None:
    for name in rewire_jax.__all__:
        assert f'id="rewire_jax.{name}"' in site["api"]
    for name in ("base.Method", "spec.Spec", "wiring.refine"):
        assert f'id="rewire_jax.methods.{name}"' in site["api"]
    assert 'id="rewire_jax.envs.base.Environment"' in site["api"]


def test_committed_results_are_shown(site) -> None:
    title = (ROOT / "experiments/results/model-sizes.md").read_text().splitlines()[0]
    assert title.removeprefix("# ") in site["results"]
    assert "made:" not in "".join(site.values())


def test_notebooks_are_shown_with_their_outputs(site) -> None:
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        assert 'class="cell_output' in site[path.stem]


def test_nothing_is_fetched_to_read_it(site) -> None:
    for page in site.values():
        assert not re.findall(r"<(?:script|link|img)[^>]*=\"(?:https?:)?//", page)


def numbers(drawing: Path) -> np.ndarray:
    """The coordinates of all lines."""
    lines = re.findall(r' d="(.*?)"', drawing.read_text(), re.S)
    return np.array(re.findall(r"-?\d+\.\d+", " ".join(lines)), float)


def test_drawings_are_the_same_each_time(tmp_path: Path) -> None:
    first, second = (drawings.write(tmp_path / name) for name in "ab")
    assert [path.stem for path in first] == ["permutation", "modes", "alignment"]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
        # Other versions of the libraries may round colours differently.
        shown, made = (
            re.findall("<text.*?>(.*?)</text>", path.read_text())
            for path in (drawings.FOLDER / one.name, one)
        )
        assert shown == made != []
        lines = [numbers(path) for path in (drawings.FOLDER / one.name, one)]
        np.testing.assert_allclose(*lines, atol=0.5)


def test_the_files_of_a_run_are_told(site, tmp_path: Path) -> None:
    settings = dataclasses.replace(tiny(), seeds=1, tasks=1, interactions=320)
    folder = rewire_jax.train(settings, tmp_path / "run")
    known = codes(site["files"])
    files = {path.name for path in folder.iterdir()}
    assert {name.replace("checkpoints", "checkpoints/") for name in files} <= known
    told = set(json.loads((folder / "settings.json").read_text()))
    for table in folder.glob("*.jsonl"):
        told |= set(json.loads(table.read_text().splitlines()[-1]))
    assert {"alignment", "model_size", "compile"} <= told <= known
