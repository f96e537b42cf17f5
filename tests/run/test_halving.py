"""Successive halving, on made-up returns."""

import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.methods.shared import Shared
from rewire_jax.run import halving

NAN = float("nan")


def by_hand(returns: np.ndarray, count: int) -> tuple[int, int]:
    """The winner of `returns` `[rounds, candidates]`, and the trials it took."""
    remaining, scores, played = list(range(count)), dict.fromkeys(range(count), 0.0), 0
    for of_round in returns:
        if len(remaining) == 1:
            break
        played += len(remaining)
        for name in remaining:
            got = of_round[name]
            scores[name] += -np.inf if np.isnan(got) else got
        for _ in range(len(remaining) // 2):
            least = min(scores[name] for name in remaining)
            # Of equal candidates the last leaves; the order is that of the scores.
            remaining.remove([n for n in remaining if scores[n] == least][-1])
        remaining.sort(key=lambda name: -scores[name])
    return remaining[0], played


@pytest.mark.parametrize("most", [1, 2, 3, 5, 8])
def test_the_worse_half_leaves_in_each_round(most: int) -> None:
    rng = np.random.default_rng(most)
    rounds, batch = 4, (30, 7)
    # Few values, so that many tie.
    returns = rng.integers(-3, 4, (rounds, *batch, most)).astype(float)
    returns[rng.random(returns.shape) < 0.1] = NAN
    count = rng.integers(1, most + 1, batch)
    played = np.zeros(batch, int)

    def play(candidates, playing, round_):
        played[...] += playing.sum(axis=-1)
        return np.take_along_axis(returns[round_], candidates, axis=-1)

    places = np.broadcast_to(np.arange(most), (*batch, most))
    chosen = halving.choose(play, places, count)
    for at in np.ndindex(batch):
        own = returns[(slice(None), *at)]
        assert (chosen[at], played[at]) == by_hand(own, count[at])


def test_returns_of_all_rounds_count() -> None:
    # The last is best in the second round, but not in both together.
    returns = [{4: 9.0, 5: 1.0, 6: 8.0, 7: 0.0}, {4: 2.0, 6: 2.5}]

    def play(candidates, playing, round_):
        assert playing.all()
        return np.array([returns[round_][name] for name in candidates.tolist()])

    assert halving.choose(play, np.arange(4, 8), np.asarray(4)) == 4


def test_equal_policies_are_one_candidate() -> None:
    policies = [
        {"bias": jnp.array([float(n % 2), 0.0]), "all": Shared(jnp.full(2, n))}
        for n in (0, 1, 2, 4, 5)
    ]
    assert halving.first_equal(policies) == [0, 1, 0, 0, 1]
    assert halving.first_equal([[Shared(jnp.zeros(1))]] * 2) == [0, 0]
