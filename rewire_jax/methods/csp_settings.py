"""Settings of CSP, published ones among them."""

import dataclasses
import math
from typing import Literal

from rewire_jax.core.arguments import flag, require
from rewire_jax.core.settings import settings, traced
from rewire_jax.methods.base import CandidateScore


@settings
class CspSettings:
    """CSP, the subspace of policies.

    Attributes:
      width: neurons in each hidden layer of an anchor, a network of the subspace; 0
        means as many as in the critics.
      distribution: distribution of the mixture weights of n anchors in training.
        "flat" is Dirichlet(1, ..., 1). "peaked" is Dirichlet(1, ..., 1, n²), with most
        weight on the newest anchor.
      resample_every: steps of an episode after which new mixture weights are drawn.
      improvement: the newest anchor is kept if the best return with it exceeds
        (1 + this) times the best return without it. If returns are negative, this
        makes it easier to keep the anchor.
      samples: mixture weights that the search draws, with the newest anchor and
        without it, this many each.
      estimations: transitions over which the search averages the critics' values of
        each of these mixture weights.
      rollouts: mixture weights that the search proposes, half of them with the newest
        anchor.
      next_weights: mixture weights of the next action in the critics' target: "stored"
        uses those of the transition; "redrawn" draws others, as in the authors' code,
        so that targets do not depend on the mixture weights.
      candidate_score: score of proposed mixture weights. "episode" is the return of
        their episodes; "since_reset" is the return since the latest reset after
        episode length - 1 steps, as in the authors' code.
    """

    width: int = 0
    distribution: Literal["flat", "peaked"] = "flat"
    resample_every: int = traced(100)
    improvement: float = 0.1
    samples: int = 4096
    estimations: int = 1024
    rollouts: int = 8
    next_weights: Literal["stored", "redrawn"] = "stored"
    candidate_score: CandidateScore = "episode"

    def checked(self) -> "CspSettings":
        """Returns the settings; `UserError` if one is invalid."""
        least = {"width": 0, "resample_every": 1, "estimations": 1, "rollouts": 2}
        for name, value in least.items():
            given = getattr(self, name)
            message = f"{flag(name)} must be at least {value}, not {given}"
            require(given >= value, message)
        require(
            0 <= self.improvement < math.inf,
            f"--improvement must be at least 0, not {self.improvement}",
        )
        require(self.rollouts % 2 == 0, f"--rollouts must be even, not {self.rollouts}")
        require(
            self.samples >= self.rollouts // 2,
            f"--samples {self.samples} are too few for half of "
            f"--rollouts {self.rollouts}",
        )
        return self


# Scenario: distribution, resample_every. Published with the authors' code.
_PUBLISHED: dict[str, tuple[Literal["flat", "peaked"], int]] = {
    "halfcheetah/forgetting": ("peaked", 100),
    "halfcheetah/transfer": ("peaked", 20),
    "halfcheetah/robustness": ("flat", 20),
    "halfcheetah/compositionality": ("flat", 100),
    "ant/forgetting": ("peaked", 100),
    "ant/transfer": ("peaked", 100),
    "ant/robustness": ("flat", 100),
    "ant/compositionality": ("flat", 20),
    "humanoid/hard": ("flat", 100),
}


def preset(scenario: str, period: int, profile: str) -> CspSettings:
    """Published settings or the defaults; a shorter search in the quick profile.

    The authors' search takes the mean of the values of both states of each transition.
    Twice the transitions have the same expectation.
    """
    del period
    options = CspSettings()
    if scenario.startswith("continual_world/"):
        # Its episodes have 200 steps: about as many interactions as elsewhere.
        options = CspSettings(rollouts=32)
    if scenario in _PUBLISHED:
        distribution, every = _PUBLISHED[scenario]
        options = CspSettings(distribution=distribution, resample_every=every)
    if profile == "quick":
        return dataclasses.replace(options, samples=1024, estimations=64)
    if profile == "authors":
        # On Continual World nothing ends an episode before its time.
        if not scenario.startswith("continual_world/"):
            options = dataclasses.replace(options, candidate_score="since_reset")
        return dataclasses.replace(
            options, estimations=2 * options.estimations, next_weights="redrawn"
        )
    return options
