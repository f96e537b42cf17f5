"""Runs of single seeds, merged, are the run of all seeds."""

import json
from pathlib import Path

import numpy as np
from fake_run import write_run

from rewire_jax.storage.merged_results import merged
from rewire_jax.storage.run_results import RunData, read_run
from rewire_jax.storage.scores import RETURN


def single(folder: Path, **options) -> list[RunData]:
    seeds = (2, 1, 0)  # in any order
    return [
        read_run(write_run(folder / f"seed-{seed}", seed=seed, seeds=1, **options))
        for seed in seeds
    ]


def test_single_seeds_are_the_population(tmp_path: Path) -> None:
    options = {"rates": np.full((4, 3), 0.5)}
    together = read_run(write_run(tmp_path / "all", seeds=3, **options))
    one = merged(single(tmp_path / "each", **options))
    assert one.folder == tmp_path / "each"
    assert one.seeds == together.seeds == (0, 1, 2)
    assert (one.finished, one.training, one.selection, one.model_size) == (
        together.finished,
        together.training,
        together.selection,
        together.model_size,
    )
    assert one.measured.keys() == together.measured.keys() > {RETURN}
    for score, values in together.measured.items():
        np.testing.assert_array_equal(one.measured[score], values)
    for ours, theirs in zip(one.curve, together.curve, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])
    # Processes of their own took as long each.
    assert one.hours == 3 * together.hours


def test_curves_have_the_reports_that_all_kept_seeds_have(tmp_path: Path) -> None:
    write_run(tmp_path / "seed-0", seeds=1)
    for seed, cut in ((1, 250), (2, 500)):
        folder = write_run(
            tmp_path / f"seed-{seed}",
            seed=seed,
            seeds=1,
            diverged=(2,) if seed == 2 else (),
        )
        path = folder / "training.jsonl"
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        rows = [row for row in rows if row["interactions"] != cut]
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    one = merged([read_run(tmp_path / f"seed-{seed}") for seed in range(3)])
    assert one.diverged == (2,)
    x, values = one.curve[0]
    # What the diverged seed lacks is not missing for the others.
    np.testing.assert_array_equal(x, [500, 1000])
    assert not np.isnan(values[:2]).any()
    assert np.isnan(values[2]).all()


def test_all_seeds_may_have_diverged(tmp_path: Path) -> None:
    one = merged(single(tmp_path, diverged=(0, 1, 2)))
    assert not one.kept.any()
    assert all(x.size == 0 and values.shape == (3, 0) for x, values in one.curve)
