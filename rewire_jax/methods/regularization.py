"""FT-L2 and EWC: finetuning that is pulled back to the last task's policy."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax.core.arguments import require_counts, require_weights
from rewire_jax.core.pytrees import count
from rewire_jax.core.settings import settings
from rewire_jax.methods.base import Method
from rewire_jax.methods.finetune import FinetuneSettings, ft1
from rewire_jax.methods.spec import Spec
from rewire_jax.nn import networks
from rewire_jax.nn.networks import Linear

# Both as in the authors' code and in Continual World's.
LEAST_FISHER = 1e-5
ADDED_VARIANCE = 1e-6


@settings
class FtL2Settings:
    """FT-L2.

    Attributes:
      coefficient: weight of the squared distance to the previous task's parameters.
    """

    coefficient: float = 1.0

    def checked(self) -> "FtL2Settings":
        """Returns the settings; `UserError` if one is invalid."""
        require_weights(self, "coefficient")
        return self


@settings
class EwcSettings:
    """Elastic weight consolidation.

    Attributes:
      coefficient: weight of the squared distance to the previous task's parameters. The
        Fisher information multiplies each term of the distance.
      fisher_states: number of states over which a task's Fisher information is
        averaged.
    """

    coefficient: float = 1.0
    fisher_states: int = 1024

    def checked(self) -> "EwcSettings":
        """Returns the settings; `UserError` if one is invalid."""
        require_weights(self, "coefficient")
        require_counts(self, "fisher_states")
        return self


# Scenario: coefficient of FT-L2, of EWC. Published with the authors' code.
_PUBLISHED = {
    "halfcheetah/forgetting": (1e4, 0.01),
    "halfcheetah/transfer": (1.0, 1.0),
    "halfcheetah/robustness": (100.0, 0.01),
    "halfcheetah/compositionality": (100.0, 1.0),
    "ant/forgetting": (1e4, 0.01),
    "ant/transfer": (1.0, 1e4),
    "ant/robustness": (1.0, 100.0),
    "ant/compositionality": (100.0, 0.01),
    "humanoid/hard": (0.01, 0.01),
}
_CONTINUAL_WORLD = (1e5, 1e4)
_DEFAULT = (1.0, 1.0)


def _coefficients(scenario: str) -> tuple[float, float]:
    if scenario.startswith("continual_world/"):
        return _CONTINUAL_WORLD
    return _PUBLISHED.get(scenario, _DEFAULT)


def preset_ft_l2(scenario: str, period: int, profile: str) -> FtL2Settings:
    """The published coefficient, or 1 where there is none."""
    del period, profile
    return FtL2Settings(coefficient=_coefficients(scenario)[0])


def preset_ewc(scenario: str, period: int, profile: str) -> EwcSettings:
    """The published coefficient, or 1 where there is none; 256 states if quick.

    The authors chose theirs with a Fisher information that took half of the means
    for the log-stds and left the log-stds out.
    """
    del period
    return EwcSettings(
        coefficient=_coefficients(scenario)[1],
        fisher_states=256 if profile == "quick" else 1024,
    )


class State(NamedTuple):
    """What the pull is made of.

    Attributes:
      previous: the last task's policy.
      importance: of its numbers, layer by layer, each entry of a shape that
        broadcasts to theirs; 0 until the first task has ended.
    """

    previous: tuple[Linear, ...]
    importance: tuple[Linear, ...]


def ft_l2(spec: Spec, options: FtL2Settings) -> Method:
    """One policy, and Σ (w − w_prev)² over its weights and biases as a penalty."""

    def end_task(params, state, task, selection):
        del task, selection
        return params, State(params, jax.tree.map(jnp.ones_like, state.importance))

    return _pulled(spec, options.coefficient, lambda w: jnp.zeros(()))._replace(
        end_task=end_task, size=lambda params, state: jnp.asarray(2 * count(params))
    )


def ewc(spec: Spec, options: EwcSettings) -> Method:
    """One policy, and Σ F (w − w_prev)² as a penalty (Kirkpatrick et al. 2017).

    F is the sum of the finished tasks' diagonals of the Fisher information.
    """
    activation = networks.ACTIVATIONS[spec.network]

    def consolidate(key, params, state, task, tools):
        del task
        states = tools.sample(key, options.fisher_states).observation
        importance = jax.tree.map(
            jnp.add, state.importance, fisher_diagonal(params, states, activation)
        )
        return params, State(params, importance)

    return _pulled(spec, options.coefficient, jnp.zeros_like)._replace(
        consolidate=consolidate,
        size=lambda params, state: jnp.asarray(3 * count(params)),
    )


def _pulled(
    spec: Spec, coefficient: Any, no_importance: Callable[[jax.Array], jax.Array]
) -> Method:
    """FT-1 with the penalty that both methods share; `w -> importance` of 0."""
    plain = ft1(spec, FinetuneSettings())

    def init(key):
        params, _ = plain.init(key)
        return params, State(params, jax.tree.map(no_importance, params))

    def penalty(key, params, state, context, observation, gaussian):
        del key, context, observation, gaussian
        terms = jax.tree.map(
            lambda f, w, previous: jnp.sum(f * (w - previous) ** 2),
            state.importance,
            params,
            state.previous,
        )
        distance = sum(jax.tree.leaves(terms))
        return coefficient * distance, {"distance": distance}

    # The pull would undo a reset of the policy's neurons.
    return plain._replace(init=init, penalty=penalty, redo_policy=False)


def fisher_diagonal(
    layers: tuple[Linear, ...],
    states: jax.Array,
    activation: networks.AnyActivation = networks.activate,
) -> tuple[Linear, ...]:
    """Diagonal of the Fisher information of a policy's Gaussian, in closed form.

    One state's is Σ_i ((∂μ_i/∂w)² + 2 (∂σ_i/∂w)²) / σ_i² over the action's
    dimensions (arXiv 2105.10919, p. 21); squashing the action does not change it.
    Where the log-std is clipped its derivative is 0. As in the authors' code and in
    Continual World's, 1e-6 is added to σ², and each state's diagonal is raised to
    at least 1e-5 before the mean over states.

    Args:
      layers: layers of a plain policy.
      states: `[states, observations]`.
      activation: what is between two layers.

    Returns:
      One number for each weight and bias, shaped like `layers`.
    """

    def scaled(biases, state):
        # The squares of this vector's derivatives are the terms of the sum.
        shifted = map(Linear, [layer.weight for layer in layers], biases)
        mean, log_std = networks.mlp_policy(list(shifted), state, activation)
        std = jnp.exp(log_std)
        scale = jax.lax.stop_gradient(jnp.sqrt(std**2 + ADDED_VARIANCE))
        return jnp.concatenate([mean / scale, jnp.sqrt(2.0) * std / scale])

    def add_state(total, state):
        jacobians = jax.jacrev(scaled)([layer.bias for layer in layers], state)
        inputs = [state, *networks.hidden_activations(layers, state, activation)]
        diagonal = []
        for x, jacobian in zip(inputs, jacobians, strict=True):
            of_bias = jnp.sum(jacobian**2, axis=0)
            # A weight's derivatives are its bias's times the layer's input.
            diagonal.append(Linear(jnp.outer(of_bias, x**2), of_bias))
        clamped = jax.tree.map(lambda f: jnp.maximum(f, LEAST_FISHER), tuple(diagonal))
        return jax.tree.map(jnp.add, total, clamped), None

    zeros = jax.tree.map(jnp.zeros_like, layers)
    total, _ = jax.lax.scan(add_state, zeros, states)
    return jax.tree.map(lambda f: f / states.shape[0], total)
