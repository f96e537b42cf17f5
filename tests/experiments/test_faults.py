from pathlib import Path

import pytest

from experiments.faults.base import Case, Impossible, Kind
from experiments.try_faults import KINDS

CASES = [
    pytest.param(kind, number, id=f"{kind.name}: {case.name}")
    for kind in KINDS.values()
    for number, case in enumerate(kind.cases)
]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("faults")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "number"), CASES)
def test_no_fault_costs_a_result(kind: Kind, number: int, root: Path) -> None:
    case: Case = kind.cases[number]
    folder = root / f"{kind.name}-{number}"
    folder.mkdir()
    try:
        came = case.run(folder)
    except Impossible as why:
        pytest.skip(str(why))
    assert came.ok, came
