"""What the rewiring method trains, keeps and draws, and its sizes."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core.pytrees import learned_place
from rewire_jax.methods import wiring
from rewire_jax.methods.rewire_settings import RewireSettings
from rewire_jax.methods.spec import Spec
from rewire_jax.nn.networks import Linear


class Params(NamedTuple):
    """The trained parameters.

    Attributes:
      hidden: L layers.
      heads: output layers, stacked on a leading axis `[slots]`.
      scores: `[modes, L, n]`, a wiring for each mode.
      adapters: alignment of the previous weights with `hidden`.
    """

    hidden: tuple[Linear, ...]
    heads: Linear
    scores: jax.Array
    adapters: wiring.Adapters


class State(NamedTuple):
    """The state that is carried from task to task.

    Attributes:
      learned: `[]` int32, finished tasks.
      previous: hidden layers at the end of the previous task.
      head: the current task's head as it was when the task began.
      orders: `[slots, L, n]` int32, the cached wirings; a single one without
        caching.
      intensity: `[]`, see `RewireSettings.intensity`.
      temperature: `[]`, SAC's highest one in the current task.
      memory: states of each different task; () without cloning.
    """

    learned: jax.Array
    previous: tuple[Linear, ...]
    head: Linear
    orders: jax.Array
    intensity: jax.Array
    temperature: jax.Array
    memory: Any = ()


class Context(NamedTuple):
    """A draw for one update or one acting step, shared by all layers.

    Attributes:
      mode: `[]` int, the wiring to use; `[envs]` in acting, if environments hold modes.
      other: like `mode`, another one, the target of the distillation; `mode` if K is 1.
      noise: `[L, n]`, added to the scores of `mode`.
      key: key of dropout.
    """

    mode: jax.Array
    other: jax.Array
    noise: jax.Array
    key: jax.Array


class Design(NamedTuple):
    """What the method's functions are made from; only numbers in it may be traced.

    Attributes:
      spec: sizes of the networks and of the sequence.
      options: the method's settings.
      n: neurons in each hidden layer.
      slots: output heads.
      cached: wirings in the cache.
      modes: `[]` int, K.
    """

    spec: Spec
    options: RewireSettings
    n: int
    slots: int
    cached: int
    modes: jax.Array

    def scores(self, orders: jax.Array) -> jax.Array:
        """Evenly spaced scores `[..., n]` of orders, in the unit of the settings."""
        scores = wiring.scores_of(orders)
        return (
            scores * (self.n - 1) if self.options.score_unit == "neighbour" else scores
        )

    def valid(self) -> jax.Array:
        """`[mode_slots]` bool, the places that hold modes."""
        return jnp.arange(self.options.mode_slots) < self.modes

    def head_slot(self, state: State) -> jax.Array:
        """`[]`, of the task that is trained."""
        return state.learned % self.slots

    def known_slot(self, state: State, task: jax.Array) -> jax.Array:
        """`[]`, see `learned_place`."""
        return learned_place(task % self.slots, state.learned)
