"""What the tests of the rewiring method share: a small one, and what it should do."""

import functools

import jax
import numpy as np

from rewire_jax.methods.base import Selection
from rewire_jax.methods.rewire import rewire
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.methods.spec import Spec
from rewire_jax.nn.networks import Linear

OBSERVATIONS, ACTIONS, N, DEPTH, TASKS, SLOTS, K = 5, 2, 12, 2, 6, 3, 3
SPEC = Spec(OBSERVATIONS, ACTIONS, N, DEPTH, TASKS)
FLAT = SPEC._replace(depth=1)
KEY = jax.random.key(0)
QUIET = np.zeros((DEPTH, N), np.float32)
OBSERVATION = np.random.default_rng(0).normal(size=(7, OBSERVATIONS))
OBSERVATION = OBSERVATION.astype(np.float32)


@functools.partial(jax.jit, static_argnums=(0, 1))
def call(name, spec, options, *arguments):
    return getattr(rewire(spec, options), name)(*arguments)


def make(spec=SPEC, **values):
    """The method; as in a run, its numbers are traced, so that few are compiled."""
    options = RewireSettings(**{"modes": K, "head_slots": SLOTS} | values).checked()
    method = rewire(spec, options)
    static = ("context", "act", "size", "adjust_updates")
    traced = {
        name: functools.partial(call, name, spec, options)
        for name in method._fields
        if name not in static
    }
    return method._replace(**traced)


def orders_of(scores):
    return np.argsort(np.asarray(scores), axis=-1, kind="stable")


def random_orders(rng, *shape):
    return rng.permuted(np.broadcast_to(np.arange(N), (*shape, N)), axis=-1)


def trained(rng, params, slot=None, hidden=True):
    """What training may do to the parameters: anything to all but other heads."""

    def shift(x, size=0.3):
        noise = rng.normal(size=x.shape, scale=size)
        return np.asarray(x + noise, np.asarray(x).dtype)

    heads = jax.tree.map(shift, params.heads)
    if slot is not None:
        heads = jax.tree.map(
            lambda old, new: np.where(
                np.arange(SLOTS).reshape(-1, *[1] * (old.ndim - 1)) == slot, new, old
            ),
            params.heads,
            heads,
        )
    return params._replace(
        hidden=jax.tree.map(shift, params.hidden) if hidden else params.hidden,
        heads=heads,
        scores=shift(params.scores),
        adapters=jax.tree.map(shift, params.adapters),
    )


def selection(after, before=0.0):
    after = np.asarray(after, np.float32)
    return Selection(np.broadcast_to(np.float32(before), after.shape), after)


def play(hidden, orders, head, observation=OBSERVATION):
    """Eq. 2 and 3 in numpy: mean, log-std."""
    x = observation.astype(np.float64)
    for (weight, bias), z in zip(hidden, orders, strict=True):
        x = (x @ np.asarray(weight.T, np.float64) + bias)[:, z]
        x = np.where(x > 0, x, 0.2 * x)
    output = x @ np.asarray(head.weight.T, np.float64) + head.bias
    return output[:, :ACTIONS], np.clip(output[:, ACTIONS:], -20, 2)


def head_at(params, slot):
    return Linear(*(leaf[slot] for leaf in params.heads))


def assert_near(actual, expected, rtol=2e-5):
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)


def assert_same(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


def after_tasks(method, number, rng, **kept):
    """Parameters and state after some tasks of random learning."""
    params, state = method.init(KEY)
    for task in range(number):
        params, state = method.start_task(KEY, params, state, task)
        params = trained(rng, params, task % SLOTS, **kept)
        places = params.scores.shape[0]
        rank = selection(rng.permutation(places) + 1.0)
        params, state = method.end_task(params, state, task, rank)
    return params, state


def evenly_in(orders):
    scores = np.empty(orders.shape)
    even = np.broadcast_to(np.linspace(0, 1, orders.shape[-1]), orders.shape)
    np.put_along_axis(scores, orders, even, axis=-1)
    return scores
