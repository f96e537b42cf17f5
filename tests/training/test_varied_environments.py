"""Environments that start each episode from a reset of its own."""

import numpy as np

from tests.loops import equal
from tests.reach_loop import SCENARIO, SHAPE, begin, build, crowd, go


def test_varied_environments_start_each_episode_from_a_reset_of_its_own():
    varied = SCENARIO.environment._replace(varied=True)
    shape = SHAPE._replace(transitions=70)
    programs = [
        build("ft1", environment, shape)
        for environment in (varied, SCENARIO.environment)
    ]
    length, members = varied.episode_length, crowd()
    states = [go(p, members, begin(p, members), [3 * length])[0] for p in programs]
    fresh, stored = (np.asarray(s.collection.buffer.observation) for s in states)
    # Up to the first end nothing is different, but for rounding: the programs differ.
    np.testing.assert_allclose(fresh[:, :length], stored[:, :length], atol=1e-5)
    # One of each seed: two configurations share these.
    starts = fresh[:2, : 3 * length : length].reshape(-1, 2)
    assert len(np.unique(starts, axis=0)) == len(starts)
    same = stored[:, : 3 * length : length]
    np.testing.assert_array_equal(same[:, 0], same[:, 1])
    # What an episode led to is still known.
    finals = [np.asarray(s.collection.buffer.final) for s in states]
    np.testing.assert_allclose(finals[0][:, 0], finals[1][:, 0], atol=1e-5)
    parts = go(programs[0], members, begin(programs[0], members), [length - 1, 1, 40])
    equal(parts[0], states[0])
