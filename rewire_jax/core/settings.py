"""Settings of a run: frozen dataclasses whose numbers may be traced."""

import dataclasses
import math
import numbers
import typing
from typing import Annotated, Any, Literal, TypeVar

import jax
import tyro

from rewire_jax.core.errors import UserError

T = TypeVar("T")

TimeLimit = Literal["terminal", "bootstrap"]
"""What a time limit means to the critic: an end, or a cut to look beyond."""
CriticEntropy = Literal["sample", "batch_mean"]
"""The entropy in a critic's target: each action's own, or the batch's mean."""
PolicyStates = Literal["current", "both"]
"""States in the policy's losses: where a transition began, or where it ended, too."""


def traced(default: int) -> Any:
    """An integer setting that, like most floats, may differ between members."""
    return dataclasses.field(default=default, metadata={"traced": True})


def static(default: float) -> Any:
    """A float setting that shapes the program, and so is the same for all members."""
    return dataclasses.field(default=default, metadata={"traced": False})


@typing.dataclass_transform(frozen_default=True, kw_only_default=True)
def settings(cls: type[T]) -> type[T]:
    """A frozen keyword-only dataclass that is also a pytree.

    Floats and `traced` integers are leaves, so that they can be traced and
    vmapped over; all else shapes the program and is static.
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


@settings
class SacSettings:
    """Soft Actor-Critic.

    Attributes:
      lr_policy: Adam's learning rate for the policy.
      lr_critic: the same for both critics.
      lr_temperature: the same for the entropy temperature.
      reward_scale: factor on rewards in the critics' targets.
      target_multiplier: target entropy is minus this times the action size.
      initial_temperature: entropy temperature at the start of every task.
      discount: of future rewards, per step.
      target_rate: share of the critics that moves into their targets.
      hidden: neurons in each hidden layer.
      depth: hidden layers of the policy and of each critic.
      batch_size: transitions in an update.
      policy_delay: critic updates for each update of policy and temperature.
      target_delay: critic updates for each update of the targets.
      time_limit: what a time limit means to the critics.
      critic_entropy: what the critics' target takes for the next action's
        -log π: "sample" that of each action, "batch_mean" the mean over the batch, to
        which the authors' code comes by broadcasting.
      policy_states: states in the losses of policy and temperature: "current" those
        that the batch's transitions begin in, "both" the observations after them, too.
        In the authors' code these are, after an ended episode, the next one's first.
      noise_color: of the noise in exploring actions: 0 is white, 1 pink, 2 red
        (Eberhard et al., ICLR 2023). Updates draw white noise.
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
    batch_size: int = 256
    policy_delay: int = 2
    target_delay: int = 2
    time_limit: TimeLimit = "terminal"
    critic_entropy: CriticEntropy = "sample"
    policy_states: PolicyStates = "current"
    noise_color: float = static(0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Everything a run is made of; saved with it.

    Attributes:
      scenario: name of the task sequence.
      method: name of the method.
      profile: whose values the settings started from.
      backend: physics backend.
      reward: version of the rewards, where an environment has several.
      seed: seed of the first member.
      seeds: how many members, seeded one after the other.
      tasks: how many tasks of the sequence are run.
      interactions: training interactions (environment steps) for each task.
      paper_interactions: the same in the paper, for comparison in reports.
      envs: parallel environments of a member.
      updates: SAC updates at a time.
      update_every: steps of all environments from one time to the next.
      overlap: step environments that cannot be compiled while updates are made, by the
        policy before these updates.
      warmup: interactions of each task before its first update.
      random_interactions: interactions of each task with uniform actions.
      buffer: transitions kept at most.
      eval_episodes: episodes for each task in an evaluation.
      selection_episodes: episodes of each candidate when a method chooses among
        policies by their return; counted as interactions.
      report_every: interactions between two progress reports.
      checkpoint_every: interactions between two full checkpoints, 0 for none.
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
    "reward_scale": 0,
    "target_multiplier": 0,
    "hidden": 1,
    "depth": 1,
    "batch_size": 1,
    "policy_delay": 1,
    "target_delay": 1,
    "noise_color": 0,
}
# Counters have 32 bits, as floats have; the others only keep loops from being endless.
_LARGEST = 2**31
_LARGEST_FLOAT = 3.4e38
_AT_MOST = {"seeds": 4_096, "depth": 1_000}
_POSITIVE = ("lr_policy", "lr_critic", "lr_temperature", "initial_temperature")
_SHARE = ("discount", "target_rate")
_KINDS: dict[Any, tuple[type, str]] = {
    bool: (bool, "true or false"),
    int: (numbers.Integral, "a whole number"),
    float: (numbers.Real, "a number"),
    str: (str, "a word"),
}


def require(condition: bool, message: str) -> None:
    """Raises `UserError(message)` unless the condition holds."""
    if not condition:
        raise UserError(message)


def flag(name: str) -> str:
    """The command-line flag of a setting."""
    return "--" + name.replace("_", "-")


def check_kinds(group: Any) -> None:
    """Raises `UserError` unless all of a dataclass's values are of their kinds."""
    for name, kind in typing.get_type_hints(type(group)).items():
        value = getattr(group, name)
        told = f"not {value!r:.80}"
        if typing.get_origin(kind) is Literal:
            known = typing.get_args(kind)
            choices = ", ".join(map(str, known))
            require(value in known, f"{flag(name)} must be one of {choices}, {told}")
        elif kind in _KINDS:
            base, noun = _KINDS[kind]
            # Python counts with truth values, too.
            fits = isinstance(value, base) and isinstance(value, bool) == (kind is bool)
            require(fits, f"{flag(name)} must be {noun}, {told}")
            if kind is int:
                most = _AT_MOST.get(name, _LARGEST - 1)
                require(value <= most, f"{flag(name)} must be at most {most}, {told}")
            if kind is float:
                # NaN and infinity are told of elsewhere. Large ints are no floats.
                small = not _LARGEST_FLOAT <= abs(value) < math.inf
                require(small, f"{flag(name)} is too large for a 32-bit float: {value}")


def validate(run: Settings) -> None:
    """Raises `UserError` if a value of `run` or `run.sac` makes no sense.

    Of a method's own options only the kinds are checked here.
    """
    for group in (run, run.sac, run.options):
        check_kinds(group)
    values = vars(run) | vars(run.sac)
    for name, value in values.items():
        if isinstance(value, float):
            require(value - value == 0, f"{flag(name)} must be finite, not {value}")
    for name, least in _AT_LEAST.items():
        require(
            values[name] >= least,
            f"{flag(name)} must be at least {least:g}, not {values[name]}",
        )
    for name in _POSITIVE:
        require(values[name] > 0, f"{flag(name)} must be above 0, not {values[name]}")
    for name in _SHARE:
        require(
            0 < values[name] <= 1,
            f"{flag(name)} must lie in (0, 1], not {values[name]}",
        )
    require(
        run.interactions >= run.warmup + run.envs * run.update_every,
        f"--interactions {run.interactions} leaves nothing to learn from after "
        f"--warmup {run.warmup}: raise the one or lower the other",
    )
    require(
        run.buffer >= run.envs,
        f"--buffer {run.buffer} is below one step of --envs {run.envs}",
    )


def to_json(run: Settings) -> dict[str, Any]:
    """The settings as a JSON-ready dictionary."""
    return dataclasses.asdict(run)


def from_json(data: dict[str, Any], options: type) -> Settings:
    """The settings that `to_json` wrote; `options` is the method's settings class.

    Raises:
      UserError: if a field is missing or unknown, or its value makes no sense.
    """
    try:
        parts = {
            "sac": _filled(SacSettings, data["sac"]),
            "options": _filled(options, data["options"]),
        }
        run = _filled(Settings, data | parts)
    except (TypeError, KeyError, AttributeError) as error:
        raise UserError(f"its settings are damaged ({error})") from error
    validate(run)
    return run


def _filled(cls: type[T], data: dict[str, Any]) -> T:
    """A settings class with saved values, and the defaults of what came later."""
    fields = {field.name: field.default for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    unknown = ", ".join(sorted(data.keys() - fields.keys()))
    require(not unknown, f"it has the unknown setting {unknown}")
    lacking = [
        name
        for name, default in fields.items()
        if name not in data and default is dataclasses.MISSING
    ]
    require(not lacking, f"it has no setting {', '.join(lacking)}")
    return cls(**data)
