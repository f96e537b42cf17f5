"""Reset & Distill, against plain versions in NumPy."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.core.transition import Batch
from rewire_jax.methods.base import Tools
from rewire_jax.methods.reset_distill import ResetDistillSettings, State, reset_distill
from rewire_jax.methods.spec import Spec
from rewire_jax.nn.networks import Linear

SPEC = Spec(observations=3, actions=2, hidden=16, depth=2, tasks=5)
KEY = jax.random.key(0)
SLOTS, STATES = 3, 16
OPTIONS = ResetDistillSettings(
    states=STATES, batch=16, distill_updates=600, distill_rate=3e-3, head_slots=SLOTS
).checked()
HIDDEN = (3 * 16 + 16) + (16 * 16 + 16)
HEAD = 16 * 4 + 4


def states(task: int) -> np.ndarray:
    """A task's states, far from those of the others."""
    rng = np.random.default_rng(task)
    return (2 * task + rng.normal(size=(STATES, 3))).astype(np.float32)


@functools.cache
def compiled(options: ResetDistillSettings) -> Callable[..., Any]:
    """`Method.consolidate` of a task with these states in its buffer."""

    def consolidate(params: Any, state: State, task: Any, found: Any) -> Any:
        def sample(key: jax.Array, count: int) -> Batch:
            at = jax.random.randint(key, (count,), 0, STATES)
            return Batch(found[at], *[None] * 6)  # type: ignore[arg-type]

        tools = Tools(sample, lambda *_: pytest.fail("no critic is needed"))
        return reset_distill(SPEC, options).consolidate(KEY, params, state, task, tools)

    return jax.jit(consolidate)


@functools.cache
def after_tasks(
    number: int, options: ResetDistillSettings = OPTIONS
) -> tuple[list[Any], State]:
    """The online policies of so many tasks, and the state after them."""
    method, online = reset_distill(SPEC, options), []
    params, state = jax.jit(method.init)(KEY)
    for task in range(number):
        key = jax.random.fold_in(KEY, task)
        params, state = method.start_task(key, params, state, task)
        rng = np.random.default_rng(task)
        params = jax.tree.map(
            lambda x, rng=rng: x + 0.3 * rng.normal(size=x.shape).astype(np.float32),
            params,
        )
        online.append(params)
        kept, state = compiled(options)(params, state, task, states(task))
        jax.tree.map(np.testing.assert_array_equal, kept, params)
        _, state = method.end_task(params, state, task, None)
    return online, state


def kl(p: Any, q: Any) -> float:
    """KL(p || q) in float64, the mean over states."""
    (mean, log_std), (other, other_log_std) = (
        [np.asarray(x, np.float64) for x in pair] for pair in (p, q)
    )
    variance, other_variance = np.exp(2 * log_std), np.exp(2 * other_log_std)
    each = np.log(other_variance / variance) + variance / other_variance - 1
    return (each + (mean - other) ** 2 / other_variance).sum(axis=-1).mean() / 2


def offline(state: State, task: int, where: int) -> Any:
    """What the offline policy of a task does in the states of a task."""
    method = reset_distill(SPEC, OPTIONS)
    return method.act(method.policy(None, state, task), states(where))


def test_the_online_policy_is_drawn_anew_for_each_task() -> None:
    method = reset_distill(SPEC, OPTIONS)
    first, state = method.init(KEY)
    trained = jax.tree.map(lambda x: x + 100, first)
    keys = jax.random.split(KEY)
    drawn = [method.start_task(key, trained, state, 1) for key in keys]
    for params, kept in drawn:
        jax.tree.map(np.testing.assert_array_equal, kept, state)
        for old, new in zip(trained, params, strict=True):
            bound = old.weight.shape[1] ** -0.5
            assert np.abs(new.weight).max() <= bound
            assert np.abs(new.bias).max() <= bound
    # It depends on the key alone.
    again = method.start_task(keys[0], first, state, 2)[0]
    jax.tree.map(np.testing.assert_array_equal, again, drawn[0][0])
    assert np.abs(drawn[0][0][0].weight - drawn[1][0][0].weight).max() > 0.1
    assert method.fresh_critic


def test_the_offline_policy_imitates_what_was_learned() -> None:
    method = reset_distill(SPEC, OPTIONS)
    online, before = after_tasks(0)
    for task in range(2):
        online, after = after_tasks(task + 1)
        expert = method.act(online[-1], states(task))
        started = kl(expert, offline(before, task, task))
        assert kl(expert, offline(after, task, task)) < 0.05 * started
        # The network that the task began with is another one.
        begun, _ = method.start_task(jax.random.fold_in(KEY, task), None, before, task)
        assert kl(method.act(begun, states(task)), offline(after, task, task)) > 0.1
        before = after


def test_it_also_imitates_itself_in_stored_states() -> None:
    lost = []
    for coefficient in (0.0, 10.0):
        options = dataclasses.replace(OPTIONS, coefficient=coefficient)
        _, once = after_tasks(1, options)
        _, twice = after_tasks(2, options)
        mean, log_std = offline(once, 0, 0)
        for stored in (once.memory, twice.memory):
            at = np.asarray(stored.observation[0])[:, None] == states(0)
            rows = at.all(axis=-1).argmax(axis=1)
            np.testing.assert_allclose(stored.mean[0], mean[rows], atol=1e-5)
            np.testing.assert_allclose(stored.log_std[0], log_std[rows], atol=1e-5)
        lost.append(kl(offline(twice, 0, 0), (mean, log_std)))
    assert lost[1] < 0.1 * lost[0]


def test_directions_of_both_divergences() -> None:
    """Of one step; only the output layers' biases act, as their weights are 0.

    Both targets are far from the mean, and a little narrower. To cover its expert, the
    policy gets wider; what covers less than itself gets narrower.
    """
    options = dataclasses.replace(OPTIONS, distill_updates=1, coefficient=1.0)
    params, state = reset_distill(SPEC, options).init(KEY)

    def constant(mean: float, log_std: float) -> Linear:
        bias = jnp.array([mean, mean, log_std, log_std])
        return Linear(jnp.zeros((4, SPEC.hidden)), bias)

    heads = jax.tree.map(lambda x: jnp.stack([x] * SLOTS), constant(0.0, 0.1))
    state = state._replace(
        learned=jnp.asarray(1),
        offline=(*state.offline[:-1], heads),
        memory=state.memory._replace(mean=state.memory.mean + 2),
    )
    params = *params[:-1], constant(2.0, 0.0)
    _, after = compiled(options)(params, state, 1, states(1))
    moved = after.offline[-1].bias - heads.bias
    step = OPTIONS.distill_rate
    np.testing.assert_allclose(moved[0], [step, step, -step, -step], rtol=1e-3)
    np.testing.assert_allclose(moved[1], [step] * 4, rtol=1e-3)
    np.testing.assert_array_equal(moved[2], 0)


def test_each_task_has_its_head_and_unknown_ones_the_latest() -> None:
    method = reset_distill(SPEC, OPTIONS)
    _, state = after_tasks(2)
    for task, slot in enumerate((0, 1, 1, 0, 1)):
        head = method.policy(None, state, task)[-1]
        np.testing.assert_array_equal(head.weight, state.offline[-1].weight[slot])


def test_a_task_that_recurs_replaces_its_states() -> None:
    _, before = after_tasks(SLOTS)
    _, after = after_tasks(SLOTS + 1)
    for old, new in zip(before.memory, after.memory, strict=True):
        assert not np.array_equal(old[0], new[0])
        np.testing.assert_array_equal(old[1:], new[1:])


@pytest.mark.parametrize("tasks", [0, 2, 5])
def test_sizes(tasks: int) -> None:
    method = reset_distill(SPEC, OPTIONS)
    params, _ = method.init(KEY)
    _, state = after_tasks(tasks, dataclasses.replace(OPTIONS, distill_updates=1))
    assert method.size(params, state) == 2 * HIDDEN + (1 + SLOTS) * HEAD
    stored = min(tasks, SLOTS) * STATES * (3 + 2 + 2)
    assert method.stored(params, state) == stored


@pytest.mark.parametrize(
    "wrong",
    [
        {"coefficient": -1.0},
        {"distill_rate": 0.0},
        {"distill_updates": 0},
        {"states": 0},
        {"batch": 0},
        {"head_slots": 0},
    ],
)
def test_settings_that_cannot_be(wrong: dict[str, float]) -> None:
    (name,) = wrong
    with pytest.raises(UserError, match="--" + name.replace("_", "-")):
        dataclasses.replace(OPTIONS, **wrong).checked()  # type: ignore[arg-type]
