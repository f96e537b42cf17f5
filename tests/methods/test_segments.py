"""Methods over segments: the same functions, and which policy is a task's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.methods import METHODS, find_method, segments
from rewire_jax.methods.spec import Spec

TOLD = Spec(observations=3, actions=2, hidden=8, depth=2, tasks=3)
SPEC = TOLD._replace(segments=5)


def made(method: str, spec: Spec):
    entry = find_method(method)
    options = entry.preset("probe/reach", 3, "quick").checked()
    return segments.build(entry.make, spec, options)


def ended(method, learned, task):
    key = jax.random.fold_in(jax.random.key(1), task)
    learned = method.start_task(key, *learned, jnp.asarray(task))
    learned = jax.tree.map(
        lambda x: x + 0.1 if jnp.issubdtype(x.dtype, jnp.floating) else x, learned
    )
    return method.end_task(*learned, jnp.asarray(task), None)


def equal(one, other) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("method", ["ft_n", "rewire", "clonex", "pnn"])
def test_a_task_has_the_policy_of_its_segment(method: str) -> None:
    """As a method that is told as many tasks as there are segments."""
    ours = made(method, SPEC)
    entry = find_method(method)
    options = entry.preset("probe/reach", 5, "quick").checked()
    theirs = entry.make(TOLD._replace(tasks=5), options)
    learned, told = ours.init(jax.random.key(0)), theirs.init(jax.random.key(0))
    # Segments 0 and 1 lie in the first task, 2 in the second, 3 in both others.
    for segment, task in enumerate((0, 0, 1, 2)):
        params, state = learned
        learned = params, segments.assign(state, task, segment)
        learned, told = ended(ours, learned, segment), ended(theirs, told, segment)
    np.testing.assert_array_equal(learned[1].of_task, [1, 2, 3])
    assert equal(learned[1].inner, told[1])
    assert equal(learned[0], told[0])
    for task, segment in enumerate((1, 2, 3)):
        policy = ours.policy(*learned, jnp.asarray(task))
        assert equal(policy, theirs.policy(*told, jnp.asarray(segment)))
    assert int(ours.size(*learned)) == int(theirs.size(*told))


def test_later_tasks_have_the_latest_segment() -> None:
    state = segments.SegmentState((), jnp.zeros((2, 4), jnp.int32))
    state = segments.assign(segments.assign(state, 1, 1), 3, 2)
    np.testing.assert_array_equal(state.of_task, [[0, 1, 1, 2]] * 2)


@pytest.mark.parametrize("method", METHODS)
def test_every_function_takes_the_state_with_its_segments(method: str) -> None:
    """All that has a state goes through the wrapper: none is left as it was made."""
    ours, theirs = made(method, SPEC), made(method, TOLD)
    without = {"init", "act", "critic_input", "offline_sac"}
    for name, function in theirs._asdict().items():
        if callable(function) and name not in without:
            assert getattr(ours, name).__module__ == segments.__name__, name
    for name in without - {"init"}:
        assert (getattr(ours, name) is None) == (getattr(theirs, name) is None)


def test_methods_that_are_told_the_tasks_are_as_they_were_made() -> None:
    method = made("ft_n", TOLD)
    assert not isinstance(method.init(jax.random.key(0))[1], segments.SegmentState)


def test_recurring_tasks_share_slots_only_if_they_are_told() -> None:
    assert TOLD.slots(2) == 2
    assert TOLD.slots(9) == 3
    assert SPEC._replace(tasks=5).slots(2) == 5
