"""CKA-RL: a frozen base policy, and a pool of vectors that tasks add to it.

See arXiv 2510.19314. The first task trains the base θ. Task k has the parameters
θ + Σ softmax(s)_j v_j + v_k: it trains the logits s of the vectors v_j in the pool, and
a vector v_k of its own, which joins the pool. When the pool is full, its two most
similar vectors, by their cosine, become their mean. `docs/departures.md` lists what is
different here.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from rewire_jax.core.arguments import require_counts
from rewire_jax.core.pytrees import count, learned_place
from rewire_jax.core.settings import settings
from rewire_jax.methods.base import Method
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks


@settings
class CkaSettings:
    """CKA-RL.

    Attributes:
      pool: largest number of vectors, K_max. The policies of earlier tasks change only
        when vectors are merged. 5 is this library's choice.
    """

    pool: int = 5

    def checked(self) -> "CkaSettings":
        """Returns the settings; `UserError` if one is invalid."""
        require_counts(self, "pool")
        return self


def preset(scenario: str, period: int, profile: str) -> CkaSettings:
    """The same settings everywhere."""
    del scenario, period, profile
    return CkaSettings()


class Params(NamedTuple):
    """What a task trains.

    Attributes:
      vector: `[numbers]`, its own vector; in the first task the base itself.
      logits: `[pool]`, of the vectors in the pool.
    """

    vector: jax.Array
    logits: jax.Array


class State(NamedTuple):
    """What is carried from task to task.

    Attributes:
      learned: `[]` int32, finished tasks.
      base: `[numbers]`, the base; 0 before the first task has ended.
      pool: `[pool, numbers]`, the vectors.
      weights: `[tasks, pool]`, of the vectors in each task's policy.
    """

    learned: jax.Array
    base: jax.Array
    pool: jax.Array
    weights: jax.Array


def merge(pool: jax.Array, weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Merges the two most similar vectors, by their cosine, into their mean.

    Args:
      pool: `[n + 1, numbers]`.
      weights: `[tasks, n + 1]`. A policy with both vectors gets the sum of its weights.

    Returns:
      `[n, numbers]` and `[tasks, n]`. The last vector takes the free place.
    """
    last = len(pool) - 1
    norms = jnp.linalg.norm(pool, axis=1, keepdims=True)
    unit = pool / jnp.maximum(norms, 1e-12)
    above = jnp.triu(jnp.ones((last + 1, last + 1), bool), 1)
    best = jnp.argmax(jnp.where(above, unit @ unit.T, -jnp.inf))
    first, second = jnp.divmod(best, last + 1)
    pool = pool.at[first].set((pool[first] + pool[second]) / 2)
    weights = weights.at[:, first].add(weights[:, second])
    pool = pool.at[second].set(pool[last])
    weights = weights.at[:, second].set(weights[:, last])
    return pool[:last], weights[:, :last]


def cka(spec: Spec, options: CkaSettings) -> Method:
    """One network for each task, a weighted sum of shared vectors."""
    act = networks.policy_of(spec.network)
    size = options.pool
    shapes = jax.eval_shape(lambda: networks.init_mlp(jax.random.key(0), spec.sizes()))
    numbers = count(shapes)
    _, layers = ravel_pytree(jax.tree.map(jnp.zeros_like, shapes))

    def known(state):
        return jnp.clip(state.learned - 1, 0, size)

    def mixture(params, state):
        """`[pool]`, the softmax over the vectors in the pool; 0 if there is none."""
        valid = jnp.arange(size) < known(state)
        shifted = params.logits - jax.lax.stop_gradient(jnp.max(params.logits))
        odds = jnp.where(valid, jnp.exp(shifted), 0.0)
        return odds / jnp.maximum(jnp.sum(odds), 1e-12)

    def current(params, state):
        mixed = mixture(params, state) @ state.pool
        return layers(state.base + mixed + params.vector)

    def init(key):
        vector, _ = ravel_pytree(networks.init_mlp(key, spec.sizes()))
        return Params(vector, jnp.zeros(size)), State(
            learned=jnp.zeros((), jnp.int32),
            base=jnp.zeros(numbers),
            pool=jnp.zeros((size, numbers)),
            weights=jnp.zeros((spec.tasks, size)),
        )

    def start_task(key, params, state, task):
        del key, task
        vector = jnp.where(state.learned == 0, params.vector, 0.0)
        return Params(vector, jnp.zeros(size)), state

    def end_task(params, state, task, selection):
        del selection
        place = known(state)
        pool = jnp.concatenate([state.pool, jnp.zeros((1, numbers))])
        weights = jnp.pad(state.weights, ((0, 0), (0, 1)))
        own = jnp.pad(mixture(params, state), (0, 1)).at[place].set(1.0)
        pool = pool.at[place].set(params.vector)
        weights = weights.at[task].set(own)
        merged = merge(pool, weights)
        full = place == size
        pool, weights = jax.tree.map(
            lambda a, b: jnp.where(full, a, b), merged, (pool[:size], weights[:, :size])
        )
        first = state.learned == 0
        return params, State(
            learned=state.learned + 1,
            base=jnp.where(first, params.vector, state.base),
            pool=jnp.where(first, state.pool, pool),
            weights=jnp.where(first, state.weights, weights),
        )

    def policy(params, state, task):
        weights = state.weights[learned_place(task, state.learned)]
        kept = state.base + weights @ state.pool
        return layers(jnp.where(state.learned > 0, kept, params.vector))

    return Method(
        init=init,
        start_task=start_task,
        distribution=lambda params, state, context, observation: act(
            current(params, state), observation
        ),
        hidden=lambda params, state, observation: networks.hidden_of(spec.network)(
            current(params, state), observation
        ),
        end_task=end_task,
        policy=policy,
        act=act,
        size=lambda params, state: (
            numbers * (1 + known(state)) + state.learned * known(state)
        ),
    )
