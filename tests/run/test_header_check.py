"""Headers that were changed after training."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rewire_jax
from rewire_jax import UserError, write_report
from rewire_jax.run.header_check import check_header
from tests.changed_header import Header, changed
from tests.small_sweep import run_sweep, small


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run and a sweep."""
    root = tmp_path_factory.mktemp("trained")
    run_sweep(root / "sweep", small(seeds=2), axes={"beta": [1, 10]})
    rewire_jax.train(small(seeds=2), root / "run")
    return {"run": root / "run", "sweep": root / "sweep"}


def swap(header: Header) -> None:
    """Gives each configuration the other one's value."""
    for row in header["members"]:
        row["values"]["beta"] = 11 - row["values"]["beta"]


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("run", lambda h: h["settings"].update(interactions=640)),
        ("run", lambda h: h["settings"]["sac"].update(discount=0.5)),
        ("run", lambda h: h["settings"]["options"].update(beta=7.0)),
        ("run", lambda h: h.update(tasks=["northeast"])),
        ("run", lambda h: h.update(tasks="ab")),
        ("sweep", swap),
        ("sweep", lambda h: h["settings"].update(interactions=640)),
        ("sweep", lambda h: h["members"][3].update(configuration=0)),
        ("sweep", lambda h: h["members"][0].pop("values")),
    ],
)
def test_a_changed_header_is_refused(
    kind: str, change: Callable[[Header], Any], trained: dict[str, Path], tmp_path: Path
) -> None:
    copy = changed(trained[kind], tmp_path / "copy", change)
    with pytest.raises(UserError, match=r"settings\.json"):
        write_report([copy], tmp_path / "report")
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize("kind", ["run", "sweep"])
def test_a_header_as_it_was_written_is_taken(
    kind: str, trained: dict[str, Path], tmp_path: Path
) -> None:
    write_report([trained[kind]], tmp_path / "report")
    # Nothing to compare with.
    copy = changed(
        trained[kind], tmp_path / "copy", lambda h: h["settings"].update(envs=4)
    )
    for path in copy.glob("**/checkpoints"):
        shutil.rmtree(path)
    check_header(copy)
    # A method that is not registered here.
    copy = changed(
        trained[kind], tmp_path / "own", lambda h: h["settings"].update(method="own")
    )
    check_header(copy)


@pytest.mark.parametrize(
    "spec", [{}, {"observations": 0, "actions": 2}, {"observations": 2.5}, [2, 2]]
)
def test_sizes_in_a_header_are_checked(
    spec: Any, trained: dict[str, Path], tmp_path: Path
) -> None:
    copy = changed(trained["run"], tmp_path / "copy", lambda h: h.update(spec=spec))
    with pytest.raises(UserError, match=r"settings\.json"):
        rewire_jax.load_policies(copy)


def test_other_sizes_than_the_checkpoint_has(
    trained: dict[str, Path], tmp_path: Path
) -> None:
    def grow(header: Header) -> None:
        header["spec"]["observations"] += 1

    copy = changed(trained["run"], tmp_path / "copy", grow)
    with pytest.raises(UserError, match="does not fit"):
        rewire_jax.load_policies(copy)


def test_changed_settings_are_blamed_and_nothing_is_trained_again(
    trained: dict[str, Path], tmp_path: Path
) -> None:
    def change(header: Header) -> None:
        header["settings"]["options"]["beta"] = 7.0

    copy = changed(trained["run"], tmp_path / "copy", change)
    before = {path: path.read_bytes() for path in copy.glob("**/*.json*")}
    settings = small(seeds=2)
    options = dataclasses.replace(settings.options, beta=7.0)
    with pytest.raises(UserError, match=r"settings\.json"):
        rewire_jax.load_policies(copy)
    settings = dataclasses.replace(settings, options=options)
    with pytest.raises(UserError, match="another run"):
        rewire_jax.train(settings, copy, resume=True)
    assert {path: path.read_bytes() for path in copy.glob("**/*.json*")} == before


def test_batches_of_members_that_are_not_there(
    trained: dict[str, Path], tmp_path: Path
) -> None:
    def lose(header: Header) -> None:
        del header["members"][2:]

    copy = changed(trained["sweep"], tmp_path / "copy", lose)
    with pytest.raises(UserError, match=r"batches\.json"):
        write_report([copy], tmp_path / "report")


def test_numbers_may_be_of_any_kind(tmp_path: Path) -> None:
    settings = small(seeds=np.int64(1))
    sac = dataclasses.replace(settings.sac, discount=np.float64(0.5))
    options = dataclasses.replace(settings.options, beta=100)
    settings = dataclasses.replace(settings, sac=sac, options=options)
    folder = rewire_jax.train(settings, tmp_path / "run")
    options = dataclasses.replace(options, beta=100.0)
    again = dataclasses.replace(settings, options=options, seeds=1)
    results = (folder / "results.jsonl").read_bytes()
    rewire_jax.train(again, folder, resume=True)
    assert (folder / "results.jsonl").read_bytes() == results

    # As a tool that writes whole numbers without a point would do it.
    def shorten(header: Header) -> None:
        header["settings"]["options"]["beta"] = 100

    write_report(changed(folder, tmp_path / "copy", shorten), tmp_path / "report")


def test_other_names_of_tasks(trained: dict[str, Path], tmp_path: Path) -> None:
    copy = changed(
        trained["run"], tmp_path / "copy", lambda h: h.update(tasks=["one", "two"])
    )
    with pytest.raises(UserError, match="other tasks"):
        rewire_jax.evaluate(copy)
    with pytest.raises(UserError, match="other tasks"):
        rewire_jax.train(small(seeds=2), copy, resume=True)
