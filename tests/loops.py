"""Parts of a training loop's work on a task, whatever the loop and its tasks."""

import jax
import jax.numpy as jnp
import numpy as np


def begin(program, members, tasks, index=0):
    """The state in which all members begin a task."""
    active = np.ones(len(members.keys), bool)
    learner = program.init(members)
    return program.begin(members, learner, active, index, tasks[index])


def go(program, members, tasks, state, chunks, time=0, index=0):
    """The state after the chunks, and their reports; `state` survives."""
    state = jax.tree.map(jnp.copy, state)
    reports = []
    for steps in chunks:
        state, report = program.chunk(members, state, index, tasks[index], time, steps)
        time += steps
        reports.append(jax.tree.map(np.asarray, report))
    return state, reports


def equal(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)
