"""Methods that are not told the tasks: they learn segments of the interactions.

A segment lies between two changes that were noticed (`--boundaries detected`). A method
takes each segment for a task. Which segment belongs to which task is kept beside the
method's state, so that the policy of a task can be found.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.methods.base import Method, MethodState
from rewire_jax.methods.spec import Spec

_PLACE = {  # of the method's state among a function's arguments
    "distribution": 1,
    "policy": 1,
    "size": 1,
    "stored": 1,
    "start_task": 2,
    "extras": 1,
    "context": 1,
    "penalty": 2,
    "inspect": 1,
    "adjust_gradient": 1,
    "hidden": 1,
    "adjust_updates": 1,
    "after_round": 1,
    "consolidate": 2,
    "candidates": 1,
    "after_baseline": 1,
    "end_task": 1,
}
_CHANGES_STATE = (
    "start_task",
    "after_round",
    "consolidate",
    "after_baseline",
    "end_task",
)


class SegmentState(NamedTuple):
    """A method's state, and the segments of the tasks.

    Attributes:
      inner: the state of the method.
      of_task: `[tasks]` int32, the segment at the end of each task; for later tasks
        the latest.
    """

    inner: MethodState
    of_task: jax.Array


def build(make: Callable[[Spec, Any], Method], spec: Spec, options: Any) -> Method:
    """A method for the tasks of a sequence, or for segments if `Spec.segments`.

    Args:
      make: the method's constructor.
      spec: sizes; `tasks` is the number of tasks in both cases.
      options: the method's settings.
    """
    if not spec.segments:
        return make(spec, options)
    method = make(spec._replace(tasks=spec.segments), options)

    def init(key: jax.Array) -> tuple[Any, SegmentState]:
        params, inner = method.init(key)
        return params, SegmentState(inner, jnp.zeros(spec.tasks, jnp.int32))

    functions: dict[str, Any] = {
        name: _over_inner(function, place, name in _CHANGES_STATE)
        for name, place in _PLACE.items()
        if (function := getattr(method, name))
    }
    of_segment = functions["policy"]

    def policy(params: Any, state: SegmentState, task: jax.Array) -> Any:
        return of_segment(params, state, state.of_task[task])

    return method._replace(**functions | {"init": init, "policy": policy})


def assign(state: SegmentState, task: int, segment: int) -> SegmentState:
    """The state in which a task and all later ones belong to a segment.

    Leading axes of the state's arrays do not matter.
    """
    later = jnp.arange(state.of_task.shape[-1]) >= task
    return state._replace(of_task=jnp.where(later, segment, state.of_task))


def _over_inner(
    function: Callable[..., Any], place: int, changes: bool
) -> Callable[..., Any]:
    """A method's function over `SegmentState`."""

    def over(*arguments: Any) -> Any:
        state = arguments[place]
        inner = (*arguments[:place], state.inner, *arguments[place + 1 :])
        if not changes:
            return function(*inner)
        params, changed = function(*inner)
        return params, state._replace(inner=changed)

    return over
