import dataclasses
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax import preset
from rewire_jax.envs.scenarios import list_scenarios, make_scenario
from rewire_jax.training import run_setup
from tests.compiles import compiles

TASKS = {"halfcheetah": 8, "ant": 8, "humanoid": 4}


def train(prepared) -> None:
    """A few updates in each task."""
    program, members = prepared.program, prepared.stacked
    learner, active = program.init(members), jnp.ones(2, bool)
    first = []
    for index, task in enumerate(prepared.scenario.tasks):
        state = program.begin(members, learner, active, index, task.data)
        first.append(np.asarray(state.collection.episodes.state.observation))
        state, report = program.chunk(members, state, index, task.data, 0, 4)
        before, learner = learner, state.learner
        assert bool(jnp.all(state.active))
        assert np.all(np.asarray(report.updates) == 2)
        moved = jax.tree.map(
            lambda a, b: float(jnp.max(jnp.abs(a - b))),
            before.params,
            learner.params,
        )
        assert min(jax.tree.leaves(moved)) > 0
        hidden = task.observation_mask == 0
        assert np.all(first[-1][..., hidden] == 0)
    assert not np.array_equal(first[0][0], first[0][1])  # seeds differ


@pytest.mark.parametrize(
    "domain",
    [
        pytest.param(domain, marks=() if domain == "halfcheetah" else pytest.mark.slow)
        for domain in TASKS
    ],
)
def test_every_scenario_trains_through_all_its_tasks_in_one_program(domain) -> None:
    programs, counts = set(), Counter()
    names = [name for name in list_scenarios() if name.startswith(f"{domain}/")]
    assert len(names) == {"humanoid": 1}.get(domain, 4)
    for name in names:
        scenario = make_scenario(name)
        settings = preset(scenario, "ft1")
        sac = dataclasses.replace(
            settings.sac,
            hidden=8,
            depth=1,
            batch_size=4,
            policy_delay=1,
            target_delay=1,
        )
        settings = dataclasses.replace(
            settings, seeds=2, interactions=8, envs=2, updates=2, warmup=4, sac=sac
        )
        prepared = run_setup.prepare(settings, scenario)
        assert len(prepared.names) == TASKS[domain]
        programs.add(prepared.program)
        with compiles() as more:
            train(prepared)
        counts += more
    # One compilation served all scenarios and tasks of the domain.
    assert len(programs) == 1
    assert counts["chunk"] == counts["begin"] == 1
