"""Settings of a run: frozen dataclasses whose numbers may be traced."""

import dataclasses
import math
import numbers
import typing
from typing import Annotated, Any, Literal, TypeVar

import jax
import tyro

from rewire_jax.core.arguments import MOST, flag, require

T = TypeVar("T")

TimeLimit = Literal["terminal", "bootstrap"]
"""Whether a time limit ends the return, or the critic bootstraps beyond it."""
CriticEntropy = Literal["sample", "batch_mean"]
"""The entropy in a critic's target: of each action, or the mean over the batch."""
PolicyStates = Literal["current", "both"]
"""States in the policy's losses: the first of each transition, or both."""
Boundaries = Literal["given", "detected"]
"""Whether the learner is told when the task changes, or has to notice it."""
Network = Literal["mlp", "layer_norm", "residual"]
"""Networks of policy and critics: plain, with normalised hidden layers, or residual."""


def traced(default: int) -> Any:
    """An integer setting that may differ between members, as most floats may."""
    return dataclasses.field(default=default, metadata={"traced": True})


def static(default: float) -> Any:
    """A float setting that shapes the program; it is the same for all members."""
    return dataclasses.field(default=default, metadata={"traced": False})


@typing.dataclass_transform(frozen_default=True, kw_only_default=True)
def settings(cls: type[T]) -> type[T]:
    """A frozen keyword-only dataclass that is also a pytree.

    Floats and `traced` integers are leaves, so they can be traced and vmapped over.
    All other fields are static, because they shape the program.
    """
    cls = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
    leaves = list(traced_fields(cls))
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    jax.tree_util.register_dataclass(
        cls,
        data_fields=leaves,
        meta_fields=[f.name for f in fields if f.name not in leaves],
    )
    return cls


def traced_fields(cls: type) -> dict[str, type]:
    """Names and types of the settings that may differ between members."""
    return {
        field.name: field.type  # type: ignore[misc]
        for field in dataclasses.fields(cls)
        if field.metadata.get("traced", field.type is float)
    }


def with_traced(complete: T, given: T) -> T:
    """Returns settings with the traced values of `given` and the other values as is."""
    values = {name: getattr(given, name) for name in traced_fields(type(complete))}
    return dataclasses.replace(complete, **values)  # type: ignore[type-var]


@settings
class SacSettings:
    """Soft Actor-Critic.

    Attributes:
      lr_policy: Adam's learning rate for the policy.
      lr_critic: the same for both critics.
      lr_temperature: the same for the entropy temperature.
      reward_scale: factor on rewards in the critics' targets.
      target_multiplier: the target entropy is minus this number times the action size.
      initial_temperature: entropy temperature at the start of every task.
      discount: discount of future rewards, per step.
      target_rate: share by which a target update moves the targets to the critics.
      hidden: neurons in each hidden layer.
      depth: hidden layers of the policy and of each critic.
      network: networks of the policy and of both critics: "mlp" as in the paper;
        "layer_norm" also normalises each hidden layer's output over its neurons before
        the activation, to mean 0 and variance 1, without learned scale and offset;
        "residual" also adds to each hidden layer, except the first, the hidden layer
        before it. `rewire` then needs `--alignment off`.
      batch_size: transitions in one update.
      policy_delay: critic updates for each update of policy and temperature.
      target_delay: critic updates for each update of the targets.
      time_limit: "terminal" treats a time limit as the end of the return; "bootstrap"
        adds the value of the state there.
      critic_entropy: log-density of the next action in the critics' target: "sample"
        uses that of each action; "batch_mean" uses the mean over the batch, which has
        the same gradient as the loss in the authors' code.
      policy_states: states in the losses of policy and temperature: "current" uses the
        first state of each transition; "both" uses the first and the next state, as in
        the authors' code.
      noise_color: color of the exploration noise: 0 is white, 1 pink, 2 red
        (Eberhard et al., ICLR 2023). Updates always draw white noise.
      redo_every: critic updates between two resets of dormant neurons (ReDo, Sokar et
        al., ICML 2023), 0 for none. It resets the critics and, in `ft1`, `ft_n`,
        `sac_n` and `reset_distill`, the policy in training; other methods need its
        neurons for earlier tasks.
      dormant_threshold: a neuron is dormant if its mean absolute activation is at most
        this number times the mean of its layer.
      l2_init: coefficient of the squared distance of the critics' weights and biases
        to their first values, in the critics' loss (Kumar et al., 2023).
      parseval: coefficient of the squared distance of W Wᵀ to 2 I, for the weights W of
        the critics' hidden layers, in the critics' loss (Parseval regularization, Chung
        et al., 2024, with 0.001 on Meta-World).
      plasticity_metrics: report the share of dormant neurons and the effective rank of
        the last hidden layer, of critics and policy.
    """

    lr_policy: float = 3e-4
    lr_critic: float = 3e-4
    lr_temperature: float = 3e-4
    reward_scale: float = 1.0
    target_multiplier: float = 1.0
    initial_temperature: float = 2.0
    discount: float = 0.99
    target_rate: float = 0.005
    hidden: int = 256
    depth: int = 3
    network: Network = "mlp"
    batch_size: int = 256
    policy_delay: int = 2
    target_delay: int = 2
    time_limit: TimeLimit = "terminal"
    critic_entropy: CriticEntropy = "sample"
    policy_states: PolicyStates = "current"
    noise_color: float = static(0.0)
    redo_every: int = 0
    dormant_threshold: float = 0.025
    l2_init: float = static(0.0)
    parseval: float = static(0.0)
    plasticity_metrics: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of a run; the run saves them.

    The defaults are the paper's on Brax. `preset` makes a profile's settings.

    Attributes:
      scenario: name of the task sequence.
      method: name of the method.
      profile: the profile that gave the initial values.
      backend: physics backend.
      reward: version of the rewards, if the environment has several.
      seed: seed of the first member.
      seeds: number of members; their seeds are consecutive.
      tasks: number of tasks of the sequence to train.
      interactions: training interactions (environment steps) for each task.
      paper_interactions: the same in the paper, for comparison in reports.
      envs: parallel environments of a member.
      updates: SAC updates in one round of updates.
      update_every: vector steps between two rounds of updates.
      overlap: step the environments on the host during the updates, with the policy
        from before these updates.
      warmup: interactions of each task before its first update.
      random_interactions: interactions of each task with uniform actions.
      buffer: maximum number of transitions in the replay buffer.
      eval_episodes: episodes for each task in an evaluation.
      selection_episodes: episodes of each candidate when a method chooses between
        policies by their return; they count as interactions.
      report_every: interactions between two progress reports.
      checkpoint_every: interactions between two full checkpoints, 0 for none.
      boundaries: "given" tells the learner when the task changes; "detected" does not:
        it starts a new task when a model of the environment, checked at each progress
        report, no longer predicts what happens.
      detection_threshold: with `boundaries` "detected", a change is noticed if a
        report's score is farther than this many spreads from the median of the latest
        scores. Larger numbers give fewer false alarms and miss more changes.
      sac: Soft Actor-Critic's settings.
      options: the method's own settings.
    """

    scenario: Annotated[str, tyro.conf.Suppress]
    method: str
    profile: str
    backend: str
    reward: str = "v2"
    seed: int = 0
    seeds: int = 1
    tasks: int
    interactions: int
    paper_interactions: Annotated[int, tyro.conf.Suppress]
    envs: int = 128
    updates: int = 64
    update_every: int = 1
    overlap: bool = False
    warmup: int = 12_800
    random_interactions: int = 0
    buffer: int = 1_280_000
    eval_episodes: int = 512
    selection_episodes: int = 32
    report_every: int = 20_000
    checkpoint_every: int = 250_000
    boundaries: Boundaries = "given"
    detection_threshold: float = 4.0
    sac: SacSettings
    options: Any


_AT_LEAST: dict[str, float] = {
    "seed": 0,
    "seeds": 1,
    "tasks": 1,
    "envs": 1,
    "updates": 1,
    "update_every": 1,
    "warmup": 0,
    "random_interactions": 0,
    "buffer": 1,
    "eval_episodes": 1,
    "selection_episodes": 0,
    "report_every": 1,
    "checkpoint_every": 0,
    "detection_threshold": 0,
    "reward_scale": 0,
    "target_multiplier": 0,
    "hidden": 1,
    "depth": 1,
    "batch_size": 1,
    "policy_delay": 1,
    "target_delay": 1,
    "noise_color": 0,
    "redo_every": 0,
    "dormant_threshold": 0,
    "l2_init": 0,
    "parseval": 0,
}
# Floats have 32 bits. The other limits prevent endless loops, and the memory of all
# pairs of modes.
_LARGEST_FLOAT, _SMALLEST_FLOAT = 3.4e38, 1.2e-38
MOST_SEEDS = 4_096
MOST_EPISODES = 2**20
_AT_MOST = {
    "seeds": MOST_SEEDS,
    "depth": 1_000,
    "modes": 1_000,
    "eval_episodes": MOST_EPISODES,
    "selection_episodes": MOST_EPISODES,
}
_POSITIVE = ("lr_policy", "lr_critic", "lr_temperature", "initial_temperature")
_SHARE = ("discount", "target_rate")
_KINDS: dict[Any, tuple[type, str]] = {
    bool: (bool, "true or false"),
    int: (numbers.Integral, "a whole number"),
    float: (numbers.Real, "a number"),
    str: (str, "a word"),
}


def check_kinds(group: Any) -> None:
    """Raises `UserError` if a value of a dataclass has the wrong type."""
    for name, kind in typing.get_type_hints(type(group)).items():
        value = getattr(group, name)
        told = f"not {value!r:.80}"
        if typing.get_origin(kind) is Literal:
            known = typing.get_args(kind)
            choices = ", ".join(map(str, known))
            require(value in known, f"{flag(name)} must be one of {choices}, {told}")
        elif kind in _KINDS:
            base, noun = _KINDS[kind]
            # In Python a bool is an int, too.
            fits = isinstance(value, base) and isinstance(value, bool) == (kind is bool)
            require(fits, f"{flag(name)} must be {noun}, {told}")
            if kind is int:
                most = _AT_MOST.get(name, MOST)
                require(value <= most, f"{flag(name)} must be at most {most}, {told}")
            if kind is float:
                _check_float(flag(name), value)


def typed(group: T) -> T:
    """A dataclass whose values have their fields' types, as JSON would give them.

    A whole number for a float, or a number of NumPy, has another text, so what was
    saved with it would look like that of other settings.
    """
    values = {}
    for name, kind in typing.get_type_hints(type(group)).items():
        if kind in (bool, int, float):
            values[name] = kind(getattr(group, name))
    return dataclasses.replace(group, **values)  # type: ignore[type-var]


def typed_settings(run: Settings) -> Settings:
    """The same for settings that are valid, with those of SAC and of the method."""
    parts = {"sac": typed(run.sac), "options": typed(run.options)}
    return dataclasses.replace(typed(run), **parts)


def _check_float(name: str, value: float) -> None:
    # Comparing first: a large int is no float.
    large = abs(value) >= _LARGEST_FLOAT
    require(value == value and abs(value) != math.inf, f"{name} must be finite")
    require(not large, f"{name} is too large for a 32-bit float: {value}")
    lost = value != 0 and abs(value) < _SMALLEST_FLOAT
    require(not lost, f"{name} is too small for a 32-bit float: {value}")


def validate(run: Settings) -> None:
    """Raises `UserError` if a value of `run` or `run.sac` is invalid.

    Of the method's own options it checks only the types.
    """
    for group in (run, run.sac, run.options):
        check_kinds(group)
    values = vars(run) | vars(run.sac)
    for name, least in _AT_LEAST.items():
        require(
            values[name] >= least,
            f"{flag(name)} must be at least {least:g}, not {values[name]}",
        )
    last = run.seed + run.seeds - 1
    require(last <= MOST, f"--seed {run.seed}: the last seed would be {last}; lower it")
    for name in _POSITIVE:
        require(values[name] > 0, f"{flag(name)} must be above 0, not {values[name]}")
    for name in _SHARE:
        require(
            0 < values[name] <= 1,
            f"{flag(name)} must lie in (0, 1], not {values[name]}",
        )
    require(
        run.interactions >= run.warmup + run.envs * run.update_every,
        f"--interactions {run.interactions} leaves no update after --warmup "
        f"{run.warmup}: raise --interactions or lower --warmup",
    )
    require(
        run.sac.network != "residual" or not run.sac.redo_every,
        "--redo-every resets no neurons of --network residual, where their outputs "
        "reach all later layers: drop one of them",
    )
    require(
        run.buffer >= run.envs,
        f"--buffer {run.buffer} cannot hold one step of --envs {run.envs}: raise "
        "--buffer or lower --envs",
    )
