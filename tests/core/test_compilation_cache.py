import os
import subprocess
import sys
from pathlib import Path

import pytest

from rewire_jax.cli import main
from rewire_jax.core import compilation_cache

# What it prints: the sum, and how many functions were found in the cache and not.
SCRIPT = f"""
import importlib.util, sys
import jax, jax.numpy as jnp
spec = importlib.util.spec_from_file_location("it", {compilation_cache.__file__!r})
it = importlib.util.module_from_spec(spec)
spec.loader.exec_module(it)
seen = []
jax.monitoring.register_event_listener(lambda event, **_: seen.append(event))
it.keep_compiled(*sys.argv[1:])
total = jax.jit(lambda x: jnp.sin(x).sum())(jnp.arange(100.0))
ends = ("cache_hits", "cache_misses")
print(round(float(total), 4), *(sum(e.endswith(end) for e in seen) for end in ends))
"""


def start(caches: Path, *arguments: str, **told: str) -> subprocess.Popen:
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *arguments],
        env=env | {"XDG_CACHE_HOME": str(caches)} | told,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen) -> tuple[float, int, int, str]:
    out, error = process.communicate()
    assert process.returncode == 0, error
    total, hits, misses = out.split()
    assert float(total) == 0.3792
    return float(total), int(hits), int(misses), error


@pytest.fixture(scope="module")
def filled(tmp_path_factory) -> Path:
    """A user's folder for caches after two processes at a time."""
    caches = tmp_path_factory.mktemp("caches")
    for process in [start(caches), start(caches)]:
        _, hits, misses, error = finish(process)
        assert hits + misses > 0
        assert not error
    return caches


def entries(caches: Path) -> list[Path]:
    return sorted((caches / "rewire_jax").glob("*-cache"))


def test_second_process_compiles_nothing(filled):
    before = entries(filled)
    _, hits, misses, error = finish(start(filled))
    assert (hits, misses, error) == (len(before), 0, "")
    assert entries(filled) == before
    assert (filled / "rewire_jax").stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("damage", ["cut", "flipped", "folder"])
def test_damage_stops_nothing(filled, tmp_path, damage):
    folder = tmp_path / "rewire_jax"
    folder.mkdir()
    for entry in entries(filled):
        content = bytearray(entry.read_bytes())
        content[len(content) // 2] ^= 255
        if damage == "folder":
            (folder / entry.name).mkdir()
        else:
            kept = content if damage == "flipped" else content[: len(content) // 2]
            (folder / entry.name).write_bytes(kept)
    _, hits, _, error = finish(start(tmp_path))
    assert hits == 0
    assert error.count("\n") <= 1


def test_folder_that_cannot_be_written_stops_nothing(tmp_path):
    file = tmp_path / "file"
    file.touch()
    processes = [
        start(file),
        start(tmp_path, str(file)),
        start(tmp_path, JAX_COMPILATION_CACHE_DIR=str(file)),
    ]
    for process in processes:
        _, hits, misses, error = finish(process)
        assert (hits, misses) == (0, 0)
        assert error.count("\n") == 1
        assert str(file) in error
        assert "--cache" in error


def test_other_folder_or_none(tmp_path):
    default, other, told = (tmp_path / name for name in ("default", "other", "told"))
    jax_told = {"JAX_COMPILATION_CACHE_DIR": str(told)}
    jax_told["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    processes = [
        start(default, str(other), **jax_told),
        start(default, **jax_told),
        start(default, "off", **jax_told),
    ]
    made = [finish(process)[2] for process in processes]
    assert made == [len(list(other.iterdir())), len(list(told.iterdir())), 0]
    assert made[0] == made[1] > 0
    assert not default.exists()


def test_the_environment_says_it(tmp_path):
    default, ours, told = (tmp_path / name for name in ("default", "ours", "told"))
    jax_told = {"JAX_COMPILATION_CACHE_DIR": str(told)}
    processes = [
        start(default, REWIRE_JAX_CACHE=str(ours), **jax_told),
        start(default, REWIRE_JAX_CACHE="off"),
    ]
    made = [finish(process)[2] for process in processes]
    assert made == [len(list(ours.iterdir())), 0]
    assert made[0] > 0
    assert not default.exists()
    assert not told.exists()


FOLDERS = """
import sys
import jax
from rewire_jax.core import compilation_cache as it, kept_programs
for folder in sys.argv[1:]:
    print(it.keep_compiled(folder if folder != "none" else None))
    print(kept_programs.programs_kept(), it.environment())
"""


def test_another_process_gets_the_same_folder(tmp_path):
    words = "none", tmp_path / "own", "none", "off", "none", tmp_path / "own"
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    env["XDG_CACHE_HOME"] = str(tmp_path)
    told = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "told")}
    outs = [
        subprocess.run(
            [sys.executable, "-c", FOLDERS, *map(str, words)],
            env=env | more,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()
        for more in ({}, told)
    ]
    default, own = tmp_path / "rewire_jax", tmp_path / "own"
    kept = [str(own), f"True {{'REWIRE_JAX_CACHE': '{own}'}}"]
    off = ["None", "False {'REWIRE_JAX_CACHE': 'off'}"]
    first = [str(default), f"True {{'REWIRE_JAX_CACHE': '{default}'}}"]
    assert outs[0] == first + kept + kept + off + off + kept
    theirs = [str(tmp_path / "told"), f"False {told}"]
    assert outs[1] == theirs + kept + kept + off + off + kept


def test_command_reads_its_flag(monkeypatch, capsys):
    given = []
    monkeypatch.setattr(main, "keep_compiled", given.append)
    main.main(["list"])
    main.main(["list", "--cache", "here"])
    main.main(["list", "--cache=off", "--json"])
    assert given == [None, "here", "off"]
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main.main(["list", "--cache"])
    assert "--cache" in capsys.readouterr().err


def test_import_touches_no_device_and_sets_nothing():
    script = (
        "import jax, rewire_jax, rewire_jax.cli.main\n"
        "from jax._src import xla_bridge\n"
        "assert not xla_bridge.backends_are_initialized()\n"
        "assert jax.config.jax_compilation_cache_dir is None\n"
    )
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    subprocess.run([sys.executable, "-c", script], env=env, check=True)
