"""Continual reinforcement learning by rewiring neurons, in JAX.

Implements "Rewiring Neurons in Non-Stationary Environments" (NeurIPS 2023) and what
it is compared with. The README has the commands; this is the interface for Python.
"""

from rewire_jax.core.compilation_cache import keep_compiled
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import SacSettings, Settings
from rewire_jax.envs.base import TaskChange
from rewire_jax.envs.domains import register_domain
from rewire_jax.envs.scenarios import (
    Scenario,
    ScenarioSpec,
    list_scenarios,
    make_scenario,
    register_scenario,
)
from rewire_jax.methods import register_method
from rewire_jax.nn import MLP, Permute, RewiredDense, permute
from rewire_jax.rendering.render import render
from rewire_jax.reports.campaign_report import write_campaign_report
from rewire_jax.reports.write import write_report
from rewire_jax.run.campaign import campaign
from rewire_jax.run.campaign_status import campaign_status
from rewire_jax.run.campaign_submit import submit
from rewire_jax.run.evaluation import evaluate, info
from rewire_jax.run.interrupts import Stopped
from rewire_jax.run.policies import load_policies, load_policy
from rewire_jax.run.sweep import sweep
from rewire_jax.run.train_run import train
from rewire_jax.training.make_train import make_act, make_train
from rewire_jax.training.presets import preset
from rewire_jax.version import __version__

__all__ = [
    "MLP",
    "Permute",
    "RewiredDense",
    "SacSettings",
    "Scenario",
    "ScenarioSpec",
    "Settings",
    "Stopped",
    "TaskChange",
    "UserError",
    "__version__",
    "campaign",
    "campaign_status",
    "evaluate",
    "info",
    "keep_compiled",
    "list_scenarios",
    "load_policies",
    "load_policy",
    "make_act",
    "make_scenario",
    "make_train",
    "permute",
    "preset",
    "register_domain",
    "register_method",
    "register_scenario",
    "render",
    "submit",
    "sweep",
    "train",
    "write_campaign_report",
    "write_report",
]
