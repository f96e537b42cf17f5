"""Parts of a `TaskChange` that have the same meaning in several domains."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.errors import UserError
from rewire_jax.envs.base import Domain, Environment, Task, TaskChange

ALL_JOINTS = "*"


def action_scale(joints: Sequence[str], factors: Mapping[str, float]) -> jax.Array:
    """Factors by joint name, in the order of the environment's actions.

    Args:
      joints: the joint that each action drives, in action order.
      factors: joint name -> factor; `"*"` applies to every joint. A joint named
        in addition to `"*"` gets the product of both.

    Returns:
      `[actions]` float32.

    Raises:
      UserError: a name is neither a joint nor `"*"`.
    """
    check_names("joint", factors, [*joints, ALL_JOINTS])
    everywhere = factors.get(ALL_JOINTS, 1.0)
    scale = [everywhere * factors.get(joint, 1.0) for joint in joints]
    return jnp.asarray(np.array(scale, np.float32))


def observation_mask(size: int, hidden: float) -> jax.Array:
    """Masks the share `hidden` of an observation, rounded down.

    The choice is fixed, and the same as for the paper's tasks: numpy's legacy
    `permutation` with seed 0 of the zeros followed by the ones.

    Args:
      size: length of the observation.
      hidden: share of the entries to hide, in [0, 1].

    Returns:
      `[size]` float32 of zeros and ones.

    Raises:
      UserError: `hidden` is not a share.
    """
    if not 0 <= hidden <= 1:
        raise UserError(f"hidden must be a share in [0, 1], not {hidden}.")
    zeros = int(hidden * size)
    mask = np.repeat([0.0, 1.0], [zeros, size - zeros])
    drawn = np.random.RandomState(0).permutation(mask)
    return jnp.asarray(drawn.astype(np.float32))


def physical_domain(
    environment: Environment,
    joints: Sequence[str],
    bodies: Sequence[str],
    physics: Callable[[TaskChange], Any],
) -> Domain:
    """A domain of bodies and joints.

    Args:
      environment: shared by all tasks.
      joints: the joint that each action drives, in action order.
      bodies: names of those that a change may name.
      physics: physics of a task, from a valid change.
    """

    def make_task(change: TaskChange) -> Task:
        check_physics(change, bodies)
        size = environment.observation_size
        return Task(
            physics=physics(change),
            action_scale=action_scale(joints, change.actions),
            observation_mask=observation_mask(size, change.hidden),
        )

    return Domain(environment, make_task)


def check_physics(change: TaskChange, bodies: Sequence[str]) -> None:
    """Raises `UserError` if a domain with these bodies cannot have this change."""
    if change.extra:
        raise UserError(f"Brax tasks take no extra values: {dict(change.extra)}.")
    check_names("body", change.bodies, bodies)
    for body, factor in change.bodies.items():
        if not factor > 0:
            raise UserError(f"The factor of body {body!r} must be > 0, not {factor}.")
    if not change.friction >= 0:
        raise UserError(f"friction must be >= 0, not {change.friction}.")


def check_names(kind: str, names: Iterable[str], known: Sequence[str]) -> None:
    """Raises `UserError` for the first of `names` that is not `known`."""
    for name in names:
        if name not in known:
            choices = ", ".join(known) if known else "none"
            raise UserError(f"Unknown {kind} {name!r}; known: {choices}.")
