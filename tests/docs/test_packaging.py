"""The package as people get it: built, installed elsewhere, resolved, imported."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import rewire_jax
from tests.tiny import flags, tiny

ROOT = Path(__file__).resolve().parents[2]
# What takes long to import and is only needed for some of what there is to do.
HEAVY = (
    "brax",
    "gymnasium",
    "matplotlib",
    "metaworld",
    "mujoco",
    "orbax",
    "scipy.stats",
    "tensorboardX",
    "wandb",
)


def run(*words: object, **options) -> subprocess.CompletedProcess[str]:
    """A command's result; a failure's error output is in the exception's text."""
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, **options
    )
    assert done.returncode == 0, done.stderr
    return done


def test_an_import_is_light_and_leaves_the_devices_alone() -> None:
    code = """
import json, sys
import rewire_jax, rewire_jax.cli.main
from jax._src import xla_bridge
print(json.dumps([xla_bridge.backends_are_initialized(), sorted(sys.modules)]))
"""
    touched, modules = json.loads(run(sys.executable, "-c", code).stdout)
    assert touched is False
    assert "rewire_jax.run.train_run" in modules
    assert not set(HEAVY) & set(modules)


def test_the_version_is_everywhere_the_same() -> None:
    shown = run(sys.executable, "-m", "rewire_jax.cli.main", "--version").stdout
    assert shown == f"rewire_jax {rewire_jax.__version__}\n"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert "version" in project["dynamic"]
    newest = re.search(r"^## \[(.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert newest is not None
    assert newest[1] in (rewire_jax.__version__, "Unreleased")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A fresh environment's Python, an sdist, and a wheel made from that."""
    folder = tmp_path_factory.mktemp("packaging")
    # As of a project of someone's, which must not pass for ours.
    run("git", "init", "--quiet", folder)
    who = ["-c", "user.name=A", "-c", "user.email=a@example.org"]
    run("git", *who, "commit", "--allow-empty", "--quiet", "-m", "Theirs", cwd=folder)
    run(sys.executable, "-m", "venv", folder / "venv")
    python = folder / "venv" / "bin" / "python"
    requires = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]
    got = subprocess.run(
        [python, "-m", "pip", "install", "--quiet", *requires["requires"]],
        capture_output=True,
        text=True,
        check=False,
    )
    if got.returncode:
        pytest.skip(f"pip finds no {requires['requires']}: {got.stderr[-300:]}")
    build = [python, "-m", "hatchling", "build", "--directory", folder / "dist"]
    run(*build, "--target", "sdist", cwd=ROOT)
    (sdist,) = (folder / "dist").glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "source", filter="data")
    (source,) = (folder / "source").iterdir()
    run(*build, "--target", "wheel", cwd=source)
    (wheel,) = (folder / "dist").glob("*.whl")
    return python, sdist, wheel


@pytest.mark.slow
def test_a_wheel_holds_the_package_and_nothing_else(built) -> None:
    _, sdist, wheel = built
    assert f"-{rewire_jax.__version__}-" in wheel.name
    tracked = set(run("git", "ls-files", cwd=ROOT).stdout.split("\n"))
    package = {name for name in tracked if name.startswith("rewire_jax/")}
    names = set(zipfile.ZipFile(wheel).namelist())
    assert "rewire_jax/py.typed" in names
    extra = {name for name in names if ".dist-info/" not in name}
    untracked = run(
        "git", "ls-files", "--others", "--exclude-standard", "rewire_jax", cwd=ROOT
    )
    gone = set(run("git", "ls-files", "--deleted", cwd=ROOT).stdout.split("\n"))
    assert extra == (package | set(untracked.stdout.split())) - gone
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    for name in ("README.md", "LICENSE", "CHANGELOG.md", "tests/tiny.py"):
        assert name in inside
    assert not any(name.startswith((".ci", "runs", ".venv")) for name in inside)


@pytest.mark.slow
def test_an_installed_wheel_works_where_the_repository_is_not(
    built, tmp_path: Path
) -> None:
    python, _, wheel = built
    run(python, "-m", "pip", "install", "--quiet", "--no-deps", wheel)
    # The dependencies as they are tested, without what stands beside them: links that
    # lead back to the repository are only followed where pip made them.
    where = run(
        python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"
    ).stdout.strip()
    (Path(where) / "pinned.pth").write_text(sysconfig.get_path("purelib") + "\n")
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    there = {"cwd": tmp_path, "env": environment}
    code = "import rewire_jax; print(rewire_jax.__file__)"
    assert where in run(python, "-c", code, **there).stdout
    command = python.parent / "rewire-jax"
    assert "train SCENARIO" in run(command, "--help", **there).stdout
    settings = flags(tiny(method="ft1"))
    run(command, "train", "probe/reach", "--out", "run", *settings, **there)
    rows = run(command, "evaluate", "run", "--json", **there).stdout.splitlines()
    assert len(rows) == 2 * 4
    header = json.loads((tmp_path / "run" / "settings.json").read_text())
    assert header["provenance"]["versions"]["rewire_jax"] == rewire_jax.__version__
    assert header["provenance"]["commit"] == "unknown"
    run(command, "report", "run", **there)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extras", "expected"),
    [
        ("cw,tensorboard,wandb", {"metaworld": "3.1", "mujoco": "3.3.0", "wandb": ""}),
        ("cw-mjx", {"mtcworldmjx": "0.4", "mujoco": "3.10"}),
    ],
)
def test_what_is_asked_for_can_be_installed_together(
    built, tmp_path: Path, extras: str, expected: dict[str, str]
) -> None:
    python, _, wheel = built
    plan = tmp_path / "plan.json"
    pip = [python, "-m", "pip", "install", "--quiet", "--dry-run", "--report", plan]
    run(*pip, "--ignore-installed", f"{wheel}[{extras}]")
    found = {
        item["metadata"]["name"].lower().replace("_", "-"): item["metadata"]["version"]
        for item in json.loads(plan.read_text())["install"]
    }
    jax = "0.12" if sys.version_info >= (3, 12) else "0.10"
    for name, version in {"jax": jax, "brax": "0.14", **expected}.items():
        assert found[name].startswith(version)


@pytest.mark.slow
def test_the_newest_brax_trains_and_refuses_v1(tmp_path: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (brax,) = (name for name in project["dependencies"] if name.startswith("brax"))
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps"]
    newest = tmp_path / "newest"
    run(*pip, "--target", newest, brax)
    paths = f"{newest}{os.pathsep}{ROOT}"
    there = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": paths}}
    settings = flags(dataclasses.replace(tiny(method="ft1"), tasks=1, seeds=1))
    command = [sys.executable, "-m", "rewire_jax.cli.main"]
    train = [*command, "train", "halfcheetah/forgetting", *settings]
    run(*train, "--backend", "positional", "--out", "run", **there)
    header = json.loads((tmp_path / "run" / "settings.json").read_text())
    assert header["provenance"]["versions"]["brax"].startswith("0.14")
    refused = subprocess.run(
        [*train, "--out", "refused"], capture_output=True, text=True, **there
    )
    assert refused.returncode != 0
    assert len(refused.stderr.splitlines()) == 1
    assert "--backend" in refused.stderr
