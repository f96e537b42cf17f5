"""The interface of every environment: pure functions over pytrees."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import chex
import jax

from rewire_jax.core.arguments import check_name, is_finite
from rewire_jax.core.errors import UserError
from rewire_jax.envs.geom_trajectory import Film


class Task(NamedTuple):
    """One task of a domain, as data, so a new task needs no new compilation.

    Attributes:
      physics: pytree that the environment's functions take (brax: its `System`).
      action_scale: `[actions]`, multiplies every action before the environment and its
        control cost see it: 0 masks it, -1 inverts it.
      observation_mask: `[observations]`, multiplies every observation: 0 hides it.
    """

    physics: Any
    action_scale: jax.Array
    observation_mask: jax.Array


class State(NamedTuple):
    """One environment between two steps.

    Attributes:
      inner: pytree of the simulator's own state.
      observation: `[observations]`, masked.
      reward: `[]`, of the step that led to this state; 0 after a reset.
      terminal: `[]` bool, whether the task itself ended here; never a time limit.
      success: `[]` bool, whether the task counts as solved at this step; `()` if the
        environment does not define success.
    """

    inner: Any
    observation: jax.Array
    reward: jax.Array
    terminal: jax.Array
    success: Any = ()


class Environment(NamedTuple):
    """One unbatched environment; callers vmap over keys, states and tasks.

    Attributes:
      reset: `(task, key) -> State`.
      step: `(task, state, action) -> State`; action `[actions]` in [-1, 1].
      observation_size: length of an observation.
      action_size: length of an action.
      episode_length: steps after which an episode is cut off.
      success: whether states report success.
      varied: whether every episode in training starts from a new reset. Such an
        environment must not end an episode itself.
      film: `(task, inners) -> Film`, from `State.inner` of each frame; None if there is
        nothing to render.
    """

    reset: Callable[[Task, jax.Array], State]
    step: Callable[[Task, State, jax.Array], State]
    observation_size: int
    action_size: int
    episode_length: int
    success: bool = False
    varied: bool = False
    film: Callable[[Task, Sequence[Any]], Film] | None = None


def check_state(environment: Environment, state: State) -> State:
    """What `reset` or `step` gave, checked while it is traced.

    Raises:
      AssertionError: a shape or type is not the one that `State` names.
    """
    chex.assert_shape(state.observation, (environment.observation_size,))
    chex.assert_shape([state.reward, state.terminal], ())
    chex.assert_type([state.observation, state.reward], float)
    chex.assert_type(state.terminal, bool)
    if environment.success:
        chex.assert_shape(state.success, ())
    return state


class HostEnvironment(NamedTuple):
    """An environment that cannot be compiled; the host steps it.

    Every episode starts from a new reset. The seed and the actions of an episode must
    determine every step of it, whatever came before. A resumed run replays them to get
    back to its checkpoint.

    Attributes:
      make: `() -> gymnasium.Env`; it is pickled, and called in the process that steps
        the environment. `reset(seed=..., options={"task": index})` begins an episode
        of the task whose `Task.physics` is `index`. `step` takes float32 actions in
        [-1, 1]; it may report success as `info["success"]`. Observations are float32.
        It does not truncate. If it has a `simulation`, its episodes can be rendered:
        an object with `model`, `data` and `dt`, as of gymnasium's `MujocoEnv`.
      observation_size: length of an observation.
      action_size: length of an action.
      episode_length: steps after which an episode is cut off.
      success: whether steps report success.
    """

    make: Callable[[], Any]
    observation_size: int
    action_size: int
    episode_length: int
    success: bool = False


@dataclass(frozen=True)
class TaskChange:
    """How a task differs from its domain, by names instead of indices.

    Attributes:
      name: the task's name.
      gravity: factor on gravity.
      friction: factor on the friction of every geometry.
      bodies: body name -> factor on its mass and collision radius.
      actions: joint name -> factor on its action (0 masks, -1 inverts);
        the name `"*"` means all joints.
      hidden: share of the observation entries that are masked to 0, by a fixed
        random choice.
      extra: values with a meaning in this domain only.

    Raises:
      UserError: a number is missing, NaN or infinite.
    """

    name: str
    gravity: float = 1.0
    friction: float = 1.0
    bodies: Mapping[str, float] = field(default_factory=dict)
    actions: Mapping[str, float] = field(default_factory=dict)
    hidden: float = 0.0
    extra: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_name("task", self.name)
        for name in ("bodies", "actions", "extra"):
            if not isinstance(getattr(self, name), Mapping):
                raise UserError(f"{name} of task {self.name!r} must be a dictionary")
        given = {n: getattr(self, n) for n in ("gravity", "friction", "hidden")}
        for name, value in (
            *given.items(),
            *self.bodies.items(),
            *self.actions.items(),
        ):
            if not is_finite(value):
                raise UserError(
                    f"{name} of task {self.name!r} must be a finite number, not {value}"
                )


class Domain(NamedTuple):
    """An environment, and a function that makes its tasks.

    Attributes:
      environment: shared by all tasks of the domain.
      make_task: `TaskChange -> Task`; raises `UserError` on unknown names.
    """

    environment: Environment | HostEnvironment
    make_task: Callable[[TaskChange], Task]
