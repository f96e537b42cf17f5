import csv
import json
from dataclasses import replace

import pytest

from experiments import population, suite
from experiments.population import Population
from rewire_jax.core.errors import UserError

SMALL = Population(
    members=(2, 1), scenario="probe/reach", method="ft1", rounds=2, steps=2
)


def row(members, seconds, processor):
    sizes = dict.fromkeys(("estimated", "argument", "temporary", "output"), 1e6)
    times = {"seconds": seconds, "processor_seconds": processor}
    facts = {"members": members, "side_by_side": 8, "peak": 10**9}
    compiling = {"compile_seconds": 20.0, "compile_processor_seconds": 10.0}
    return facts | times | sizes | compiling


@pytest.mark.slow
def test_estimate_is_near_what_is_planned():
    row = population.measure(SMALL, 2)
    assert min(row.values()) > 0
    planned = row["argument"] + row["temporary"]
    assert planned / 1.5 < row["estimated"] < planned * 1.5
    # A process with JAX in it, and no more than a machine has.
    assert 1e8 < row["peak"] < 1e11


@pytest.mark.slow
def test_each_size_is_measured_in_a_process_of_its_own():
    rows = [population.apart(SMALL, members) for members in (1, 2)]
    assert [row["members"] for row in rows] == [1, 2]
    assert rows[0].keys() == rows[1].keys() == row(1, 1.0, 1.0).keys()


def test_result_is_written_from_the_smallest_on(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(population, "apart", lambda job, members: row(members, 1, 2))
    out = tmp_path / "new" / "population"
    population.run(replace(SMALL, out=out))
    rows = json.loads(out.with_suffix(".json").read_text())["rows"]
    assert [row["members"] for row in rows] == [1, 2]
    assert len(list(csv.reader(out.with_suffix(".csv").open()))) == 3
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert "2 members cost **2 times** what 1 costs" in printed
    assert "probe/reach" in printed


def test_costs_are_in_units_of_the_smallest():
    rows = [row(2, 1.0, 3.0), row(8, 0.5, 4.0), row(32, 2.0, 3.0)]
    wall, processor = (
        population.headline(rows, key) for key in ("seconds", "processor_seconds")
    )
    assert wall[0] == (
        "- 8 members cost **2 times** what 2 costs: per member 0.50 times."
    )
    assert "**32 times**" in wall[1]
    assert "**5.33 times**" in processor[0]
    assert "**16 times** what 2 costs: per member 1.00 times" in processor[1]
    assert "at most 8 side by side" in wall[2]


def test_table_adds_arguments_and_temporary_arrays():
    head, line = suite.table([row(8, 0.5e-3, 0.25e-3)], population.COLUMNS)
    assert dict(zip(head, line, strict=True)) == {
        "members": "8",
        "compile, s": "20",
        "processor s": "10",
        "estimated, MB a member": "1.0",
        "planned, MB a member": "2.0",
        "peak, MB": "1,000",
        "ms a member and interaction": "0.5",
        "processor ms": "0.25",
    }


def test_wrong_sizes_are_told_before_anything_is_measured():
    for wrong in ({"members": (0, 8)}, {"members": ()}, {"rounds": 0}, {"steps": 0}):
        with pytest.raises(UserError, match="must be at least 1"):
            population.run(Population(**wrong))


def test_a_failed_measurement_is_told(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "none-such")
    with pytest.raises(UserError, match="measuring 1 members failed"):
        population.apart(SMALL, 1)
