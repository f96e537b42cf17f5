"""The committed model sizes, against formulas and against what is measured."""

import itertools
import json
from pathlib import Path

from experiments import model_sizes, suite

COMMITTED = Path(__file__).parents[2] / "experiments/results/model-sizes.json"
HEADS = {"halfcheetah/robustness": 2, "ant/robustness": 2}


def formula(method, row):
    """Numbers stored at the most, written out a second time."""
    o, a, n = row["observations"], row["actions"], row["hidden"]
    tasks, w = row["tasks"], 96

    def plain(width):
        sizes = [o, width, width, width, 2 * a]
        return sum(i * j + j for i, j in itertools.pairwise(sizes))

    column = plain(w)
    outer = 2 * (w * w + w) + w * 2 * a + 2 * a + 3
    inner = sum(3 * (w * place) * w for place in range(tasks))
    heads = HEADS.get(row["scenario"], 4)
    head = n * 2 * a + 2 * a
    scores, orders, adapters = 3 * 3 * n, heads * 3 * n, 3 * n + 2 * n
    hidden = plain(n) - head
    return {
        "ft1": plain(n),
        "ft_l2": 2 * plain(n),
        "packnet": 2 * plain(n),
        "ewc": 3 * plain(n),
        "pnn": tasks * column + (tasks - 1) * outer + inner,
        "sac_n": tasks * plain(n),
        "ft_n": tasks * plain(n),
        "csp": tasks * plain(n),
        "rewire": 2 * hidden + (heads + 1) * head + scores + orders + adapters,
    }[method]


def test_committed_model_sizes_follow_the_formulas():
    found = json.loads(COMMITTED.read_text())["rows"]
    assert {row["scenario"] for row in found} == {
        name for names in suite.DOMAINS.values() for name in names
    }
    for row in found:
        assert row["most"] == formula(row["method"], row), row
        least = row["plain"] if row["method"] == "csp" else row["most"]
        assert row["least"] == least
        assert row["plain"] == formula("ft1", row)
    shown = COMMITTED.with_suffix(".md").read_text()
    for line in model_sizes.table(found):
        assert f"| {' | '.join(line)} |" in shown


def test_model_sizes_are_those_committed():
    name = "halfcheetah/robustness"
    found = json.loads(COMMITTED.read_text())["rows"]
    expected = [r for r in found if r["scenario"] == name and r["observations"] == 18]
    assert len(expected) == 9
    assert list(itertools.islice(model_sizes.measure(name), 9)) == expected
