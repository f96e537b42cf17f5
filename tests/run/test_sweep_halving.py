"""Sweeps that drop configurations after a task, and random ones."""

import json
from pathlib import Path

import numpy as np
import pytest

from rewire_jax.cli import main
from tests.small_sweep import near, rows, run_sweep, small, sweep_words


@pytest.mark.slow
def test_halving_keeps_the_best_configurations(tmp_path: Path) -> None:
    # Learning rates far apart, so that there is a better and a worse.
    settings = small(seeds=2, tasks=3, interactions=480)
    axis = {"lr_policy": [1e-5, 3e-3, 1e-4, 1e-3, 1e30]}
    options = {"axes": axis, "members_per_batch": 4}
    whole = rows(run_sweep(tmp_path / "whole", settings, **options))
    halved = rows(run_sweep(tmp_path / "halved", settings, **options, halving=2))
    chosen = [range(10)]
    for stage in (0, 1):
        scores = {}
        for configuration in {member // 2 for member in chosen[-1]}:
            seeds = [2 * configuration, 2 * configuration + 1]
            mine = [whole[stage, m, t] for m in seeds for t in range(stage + 1)]
            bad = sum(whole[stage, m, 0]["diverged"] for m in seeds)
            mean = -np.inf if bad == 2 else np.mean([row["choice"] for row in mine])
            scores[configuration] = (-bad, mean)
        best = sorted(scores, key=scores.__getitem__, reverse=True)
        best = best[: -(-len(best) // 2)]
        chosen.append([m for c in sorted(best) for m in (2 * c, 2 * c + 1)])
    assert [len(members) for members in chosen] == [10, 6, 4]
    for stage, members in enumerate(chosen):
        assert {place[1] for place in halved if place[0] == stage} == set(members)
    # The absurd one diverged, is marked, and is not among the best.
    assert whole[2, 8, 0]["diverged"]
    assert halved[0, 9, 0]["diverged"]
    assert 8 not in chosen[1]
    # Those that are left go on as if the others were there.
    near(halved, {place: whole[place] for place in halved})


@pytest.mark.slow
def test_random_and_halved_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # K is kept; of four configurations two and one go on.
    words = sweep_words(tmp_path / "sweep", most=2)
    words = [*words[: words.index("--modes")], "--modes", "1", "--beta", "0.1", "10"]
    main.main([*words, "--random", "4", "--halving", "2"])
    assert "4 configurations" in " ".join(capsys.readouterr().out.split())
    header = json.loads((tmp_path / "sweep/settings.json").read_text())
    values = [member["values"] for member in header["members"]]
    assert {value["modes"] for value in values} == {1}
    assert len({value["beta"] for value in values}) == 4
    found = rows(tmp_path / "sweep")
    assert len({place[1] for place in found if place[0] == 0}) == 4
    assert len({place[1] for place in found if place[0] == 1}) == 2
