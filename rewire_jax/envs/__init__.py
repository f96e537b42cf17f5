"""Environments and scenarios, and what a domain of your own is made of."""

from rewire_jax.envs.base import (
    Domain,
    Environment,
    HostEnvironment,
    State,
    Task,
    TaskChange,
)
from rewire_jax.envs.geom_trajectory import Film

__all__ = [
    "Domain",
    "Environment",
    "Film",
    "HostEnvironment",
    "State",
    "Task",
    "TaskChange",
]
