"""Small anchors, weights and policies of CSP, and what they should give."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.transition import Batch
from rewire_jax.methods import csp
from rewire_jax.methods.base import Selection
from rewire_jax.methods.csp_settings import CspSettings
from rewire_jax.methods.spec import Spec

OBSERVATIONS, ACTIONS, TASKS = 3, 2, 4
SPEC = Spec(OBSERVATIONS, ACTIONS, hidden=5, depth=2, tasks=TASKS)
KEY = jax.random.key(0)
SEARCH = {"samples": 16, "estimations": 5, "rollouts": 4}
OBSERVATION = np.random.default_rng(0).normal(size=(7, OBSERVATIONS))
OBSERVATION = OBSERVATION.astype(np.float32)


@functools.partial(jax.jit, static_argnums=(0, 1))
def call(name, purpose, options, *arguments):
    method = csp.csp(SPEC, options)
    if purpose:
        key, state, extras = arguments
        return method.context(key, state, purpose, extras)
    return getattr(method, name)(*arguments)


def make(**values):
    """The method, compiled; as in a run, its numbers are traced."""
    options = CspSettings(**SEARCH | values).checked()
    method = csp.csp(SPEC, options)
    traced = ("init", "distribution", "policy", "extras", "candidates", "end_task")

    def context(key, state, purpose, extras):
        return call("context", purpose, options, key, state, extras)

    return method._replace(
        context=context,
        **{name: functools.partial(call, name, None, options) for name in traced},
    )


def random_anchors(rng, number=TASKS):
    like, _ = make().init(KEY)
    return jax.tree.map(
        lambda x: rng.normal(size=(number, *x.shape)).astype(np.float32), like
    )


def in_training(rng, frozen, **values):
    """The method in a task that began with some frozen anchors, and these."""
    method = make(**values)
    params, state = method.init(KEY)
    anchors = random_anchors(rng)
    params = jax.tree.map(lambda x: x[frozen], anchors)

    def cut(x):
        used = np.arange(TASKS).reshape(-1, *[1] * (x.ndim - 1)) < frozen
        return np.where(used, x, np.zeros_like(x))

    return (
        method,
        params,
        state._replace(
            learned=jnp.int32(frozen),
            frozen=jnp.int32(frozen),
            anchors=jax.tree.map(cut, anchors),
            proposals=random_weights(rng, 4, frozen + 1),
        ),
        anchors,
    )


def random_weights(rng, rows, used):
    drawn = np.zeros((rows, TASKS), np.float32)
    drawn[:, :used] = rng.dirichlet(np.ones(used), rows)
    return drawn


def folded(anchors, weights):
    """The weighted sum of the anchors, in float64."""
    return jax.tree.map(
        lambda x: np.tensordot(np.asarray(weights, np.float64), x, 1), anchors
    )


def play(anchors, weights, observation):
    """One sample through the mixture of anchors, layer by layer: mean, log-std."""
    x = observation.astype(np.float64)
    for index, (weight, bias) in enumerate(anchors):
        x = np.where(x > 0, x, 0.2 * x) if index else x
        x = sum(
            w * (np.asarray(weight[a], np.float64) @ x + bias[a])
            for a, w in enumerate(weights)
        )
    return x[:ACTIONS], np.clip(x[ACTIONS:], -20, 2)


def assert_near(actual, expected, tolerance=2e-5):
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=tolerance, atol=tolerance),
        actual,
        expected,
    )


def assert_same(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


def selection(*after):
    return Selection(None, np.array(after, np.float32))


# Settings


def assert_on_simplex(weights, used):
    weights = np.asarray(weights)
    assert np.all(weights >= 0)
    np.testing.assert_allclose(weights.sum(-1), 1, atol=1e-6)
    assert np.all(weights[..., used:] == 0)


def assert_dirichlet(weights, concentration):
    """Means and variances are those of a Dirichlet distribution."""
    assert_on_simplex(weights, len(concentration))
    total = sum(concentration)
    mean = np.array(concentration) / total
    variance = mean * (1 - mean) / (total + 1)
    drawn = np.asarray(weights, np.float64)[:, : len(concentration)]
    error = np.sqrt(variance / len(drawn))
    assert np.all(np.abs(drawn.mean(0) - mean) <= 4.5 * error)
    np.testing.assert_allclose(drawn.var(0), variance, rtol=0.15)


def batch_of(observation):
    fields = dict.fromkeys(Batch._fields)
    action = jnp.zeros((len(observation), ACTIONS))
    return Batch(**fields | {"observation": observation, "action": action})
