"""A checkpoint, saved once for all tests that need one."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from rewire_jax.storage.checkpoint import save
from tests.small_checkpoint import POLICY


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("template") / "task-00"
    save(path, POLICY | {"rest": np.arange(9)}, {"order": 0})
    return path


@pytest.fixture
def saved(template: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(template, tmp_path / "checkpoints" / "task-00"))
