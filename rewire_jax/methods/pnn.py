"""Progressive networks: a column for each task, fed by all before (arXiv 1606.04671).

Column k computes, from the hidden activations h of the columns before it, in every
layer i but the first

    x_i = W_i h_{i-1} + U_i activate(V_i (a_i [h_{i-1} of column 0, ..., k - 1])),

biases in W and U, and column 0 computes only W_i h_{i-1}. Arrays have room for the
whole sequence: the activations of columns that do not come before are zeros, so that
their part of V neither matters nor learns.

With `--network layer_norm`, each column normalises its hidden layers' x_i. The inner
layers V are not normalised, which would cancel the scale a. With `--network residual`
it also adds its own h_{i-1} to h_i.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core.arguments import require_counts
from rewire_jax.core.pytrees import at, count, learned_place, put, tile
from rewire_jax.core.settings import settings
from rewire_jax.methods.base import Act, Method
from rewire_jax.methods.shared import Shared
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.nn.networks import Linear


@settings
class PnnSettings:
    """Progressive networks.

    Attributes:
      width: neurons in each hidden layer of a column.
    """

    width: int = 96

    def checked(self) -> "PnnSettings":
        """Returns the settings; `UserError` if one is invalid."""
        require_counts(self, "width")
        return self


def preset(scenario: str, period: int, profile: str) -> PnnSettings:
    """The published width, half of it in the quick profile."""
    del scenario, period
    return PnnSettings(width=48 if profile == "quick" else 96)


class Lateral(NamedTuple):
    """A layer's connection to the layer below it in the earlier columns.

    Attributes:
      scale: `[]`, a.
      inner: `[width, slots * width]`, V.
      outer: `width -> outputs`, U.
    """

    scale: jax.Array
    inner: jax.Array
    outer: Linear


class Column(NamedTuple):
    """One task's network.

    Attributes:
      layers: W of all layers.
      laterals: those of all layers but the first.
    """

    layers: tuple[Linear, ...]
    laterals: tuple[Lateral, ...]


class State(NamedTuple):
    """Finished columns.

    Attributes:
      learned: `[]` number of finished tasks.
      columns: `[tasks, ...]`; until then all are as they were made.
    """

    learned: jax.Array
    columns: Column


class Policy(NamedTuple):
    """One of the finished columns.

    Attributes:
      columns: `[tasks, ...]`, the same for all tasks.
      place: `[]`, that of the column whose output is the policy's.
    """

    columns: Shared
    place: jax.Array


def pnn(spec: Spec, options: PnnSettings) -> Method:
    """Each task trains a new column; those before it are frozen."""
    width, tasks = options.width, spec.tasks
    activation = networks.ACTIVATIONS[spec.network]
    sizes = spec.sizes(width)

    def init_column(key, place):
        key, *keys = jax.random.split(key, spec.depth + 1)
        earlier = jnp.maximum(place, 1)

        def lateral(key, outputs):
            scale_key, inner_key, outer_key = jax.random.split(key, 3)
            shape = (width, max(tasks - 1, 1) * width)
            bound = (earlier * width) ** -0.5
            return Lateral(
                scale=jax.random.uniform(scale_key) / earlier,
                inner=bound * jax.random.uniform(inner_key, shape, minval=-1.0),
                outer=networks.init_linear(outer_key, width, outputs),
            )

        return Column(
            layers=networks.init_mlp(key, sizes),
            laterals=tuple(map(lateral, keys, sizes[2:])),
        )

    def init(key):
        params = init_column(key, jnp.zeros((), jnp.int32))
        return params, State(jnp.zeros((), jnp.int32), tile(params, tasks))

    def start_task(key, params, state, task):
        del params
        return init_column(key, task), state

    def distribution(params, state, context, observation):
        del context
        return play(state.columns, params, state.learned, observation, activation)

    def hidden(params, state, observation):
        arguments = state.columns, params, state.learned, observation, activation
        return run_columns(*arguments)[0]

    def end_task(params, state, task, selection):
        del selection
        columns = put(state.columns, task, params)
        return params, State(state.learned + 1, columns)

    def policy(params, state, task):
        del params
        place = learned_place(task, state.learned)
        return Policy(Shared(state.columns), place)

    def size(params, state):
        columns = jnp.maximum(state.learned, 1)
        scales_and_outer = count([(x.scale, x.outer) for x in params.laterals])
        inner = spec.depth * width * width
        pairs = columns * (columns - 1) // 2
        laterals = (columns - 1) * scales_and_outer + pairs * inner
        return columns * count(params.layers) + laterals

    return Method(
        init=init,
        distribution=distribution,
        policy=policy,
        act=act_of(spec.network),
        size=size,
        hidden=hidden,
        start_task=start_task,
        end_task=end_task,
    )


@functools.cache
def act_of(network: str) -> Act:
    """How to act by a frozen column; always the same object for a network's name."""
    activation = networks.ACTIVATIONS[network]

    def act(policy: Policy, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        (columns,), place = policy
        return play(columns, at(columns, place), place, observation, activation)

    return act


def play(
    columns: Column,
    column: Column,
    place: jax.Array,
    observation: jax.Array,
    activation: networks.AnyActivation,
) -> tuple[jax.Array, jax.Array]:
    """Mean and log-std of a column, each `[..., actions]`; see `run_columns`."""
    arguments = columns, column, place, observation, activation
    return networks.gaussian(run_columns(*arguments)[1])


def run_columns(
    columns: Column,
    column: Column,
    place: jax.Array,
    observation: jax.Array,
    activation: networks.AnyActivation,
) -> tuple[list[jax.Array], jax.Array]:
    """`run_column`, and what comes before; gradients flow only into this column.

    Args:
      columns: `[tasks, ...]`, of which the first `place` come before it.
      column: the column that is played.
      place: `[]`, its place in the sequence.
      observation: `[..., observations]`.
      activation: of the hidden layers.

    Returns:
      As `run_column`.
    """
    # A loop of unknown length has no gradient, and needs none.
    columns, observation = jax.lax.stop_gradient((columns, observation))
    width = column.layers[0].bias.size
    shape = (*observation.shape[:-1], column.laterals[0].inner.shape[1])
    nothing = [jnp.zeros(shape, observation.dtype) for _ in column.laterals]

    def join(place, earlier):
        hidden, _ = run_column(
            at(columns, place), place, earlier, observation, activation
        )
        return [
            jax.lax.dynamic_update_slice_in_dim(joined, x, place * width, axis=-1)
            for joined, x in zip(earlier, hidden, strict=True)
        ]

    earlier = jax.lax.fori_loop(0, place, join, nothing)
    return run_column(column, place, earlier, observation, activation)


def run_column(
    column: Column,
    place: jax.Array,
    earlier: list[jax.Array],
    observation: jax.Array,
    activation: networks.AnyActivation,
) -> tuple[list[jax.Array], jax.Array]:
    """A column's hidden activations and output.

    Args:
      column: the column.
      place: `[]`, its place in the sequence.
      earlier: for each hidden layer the activations `[..., slots * width]` of the
        columns before it, side by side, then zeros.
      observation: `[..., observations]`.
      activation: of the hidden layers.

    Returns:
      Activations `[..., width]` of each hidden layer, and `[..., 2 * actions]`.
    """
    first, *layers = column.layers
    x = networks.affine(first, observation)
    hidden: list[jax.Array] = []
    for layer, lateral, below in zip(layers, column.laterals, earlier, strict=True):
        x = networks.between(activation, x, hidden[-1] if hidden else None)
        hidden.append(x)
        inner = networks.activate((lateral.scale * below) @ lateral.inner.T)
        side = networks.affine(lateral.outer, inner)
        # The authors' first column activates its output, too, which looks like a slip.
        x = networks.affine(layer, x) + jnp.where(place > 0, side, 0.0)
    return hidden, x
