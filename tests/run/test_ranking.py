"""The order of configurations."""

import itertools

import numpy as np

from rewire_jax.run.ranking import rank

NAN = float("nan")


def test_divergence_counts_before_the_mean_and_ties_keep_their_order():
    scores = [
        [9, NAN, NAN],  # the highest mean of all, of one seed
        [1, 2, 3],
        [NAN, NAN, NAN],
        [8, NAN, 8],
        [3, 2, 1],  # as good as 1
        [-5, -5, -4],
        [NAN, NAN, NAN],
        [0, 0, 30],
    ]
    assert rank(scores).tolist() == [7, 1, 4, 5, 3, 0, 2, 6]


def test_order_is_that_of_comparing_every_pair():
    rng = np.random.default_rng(0)
    # Few values, so that many tie.
    scores = rng.integers(-2, 3, (40, 3)).astype(float)
    scores[rng.random(scores.shape) < 0.3] = np.nan

    def before(a: int, b: int) -> bool:
        one, other = ([x for x in scores[i] if x == x] for i in (a, b))
        if len(one) != len(other):
            return len(one) > len(other)
        # As many seeds: sums compare as means do.
        return a < b if sum(one) == sum(other) else sum(one) > sum(other)

    order = rank(scores).tolist()
    assert sorted(order) == list(range(40))
    assert all(before(a, b) for a, b in itertools.combinations(order, 2))


def test_without_configurations():
    assert rank(np.zeros((0, 3))).tolist() == []
