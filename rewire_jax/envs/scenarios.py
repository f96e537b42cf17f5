"""Sequences of tasks, as data: the paper's scenarios and one probe."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rewire_jax.core.arguments import check_name, check_whole
from rewire_jax.core.errors import UserError
from rewire_jax.envs.base import Environment, HostEnvironment, Task, TaskChange
from rewire_jax.envs.domains import DOMAINS, unknown
from rewire_jax.envs.metaworld import REWARDS
from rewire_jax.envs.task_parameters import check_names


@dataclass(frozen=True)
class ScenarioSpec:
    """A scenario before anything is built.

    Attributes:
      name: its name, by convention `"domain/kind"`.
      domain: `"halfcheetah"`, `"ant"`, `"humanoid"`, `"metaworld"`, a probe's name, or
        one given to `register_domain`.
      changes: the tasks in order; equal changes are the same task, which recurs.
      repeats: how often the whole list is repeated.
      interactions: environment steps of training for each task.
      preset: name of the scenario whose settings `preset` gives this one, such as
        "halfcheetah/forgetting"; its own by default, which for a scenario of one's
        own means the defaults.

    Raises:
      UserError: a value is invalid.
    """

    name: str
    domain: str
    changes: tuple[TaskChange, ...]
    repeats: int
    interactions: int
    preset: str = ""

    def __post_init__(self) -> None:
        check_name("scenario", self.name)
        for name in ("repeats", "interactions"):
            check_whole(f"{name} of scenario {self.name!r}", getattr(self, name), 1)
        if not isinstance(self.changes, tuple) or not all(
            isinstance(change, TaskChange) for change in self.changes
        ):
            raise UserError(f"Scenario {self.name!r} needs a tuple of TaskChange.")
        for name in ("domain", "preset"):
            if not isinstance(getattr(self, name), str):
                raise UserError(f"{name} of scenario {self.name!r} must be a name.")
        if self.domain not in DOMAINS:
            raise UserError(unknown("domain", self.domain, list(DOMAINS)))
        if not self.changes:
            raise UserError(f"Scenario {self.name!r} needs at least one change.")
        if self.preset and self.preset not in SCENARIOS:
            raise UserError(unknown("preset", self.preset, list(SCENARIOS)))
        named = {change.name: change for change in self.changes}
        if any(named[change.name] != change for change in self.changes):
            raise UserError(f"Scenario {self.name!r} gives one name to two tasks.")


@dataclass(frozen=True, eq=False)
class ScenarioTask:
    """One place in a sequence.

    Attributes:
      name: the task's name.
      distinct: index among the scenario's distinct tasks, from 0.
      data: the environment's input; if the task recurs, the same object.
      change: what `data` was made from; None if it was made in another way.
    """

    name: str
    distinct: int
    data: Task
    change: TaskChange | None = None

    @property
    def action_scale(self) -> np.ndarray:
        """`[actions]`."""
        return np.asarray(self.data.action_scale)

    @property
    def observation_mask(self) -> np.ndarray:
        """`[observations]`."""
        return np.asarray(self.data.observation_mask)


@dataclass(frozen=True, eq=False)
class Scenario:
    """A scenario that can be run.

    Attributes:
      name: name in its spec.
      domain: name of its domain.
      backend: physics backend, `"probe"` for a probe.
      reward: version of the rewards, where the domain has several.
      environment: environment of all tasks; the same object for each domain and
        backend.
      tasks: the whole sequence, repeats included.
      distinct: number of distinct tasks.
      interactions: environment steps of training for each task.
      preset: name of the scenario whose settings `preset` gives this one.
    """

    name: str
    domain: str
    backend: str
    reward: str
    environment: Environment | HostEnvironment
    tasks: tuple[ScenarioTask, ...]
    distinct: int
    interactions: int
    preset: str


def make_scenario(
    spec: ScenarioSpec | str, backend: str | None = None, reward: str = "v2"
) -> Scenario:
    """Builds a scenario.

    Args:
      spec: a spec, or the name of a known one.
      backend: physics backend, the domain's first if None; probes and registered
        domains have only that.
      reward: version of Meta-World's rewards, `"v1"` or `"v2"`; others ignore it.

    Returns:
      The scenario, its tasks ready for the environment.

    Raises:
      UserError: an unknown scenario, backend, reward, body or joint.
    """
    if isinstance(spec, str):
        if spec not in SCENARIOS:
            raise UserError(unknown("scenario", spec, list(SCENARIOS)))
        spec = SCENARIOS[spec]
    _check_spec(spec)
    check_names("reward", [reward], REWARDS)
    kind = DOMAINS[spec.domain]
    if backend is None:
        backend = kind.backend
    elif kind.backend in ("probe", "own") and backend != kind.backend:
        raise UserError(f"{spec.name} has no other backend: drop --backend {backend}")
    domain = kind.make(spec.domain, spec.changes, backend, reward)
    names = list(dict.fromkeys(change.name for change in spec.changes))
    changes = {change.name: change for change in spec.changes}
    data = {name: domain.make_task(changes[name]) for name in names}
    once = [
        ScenarioTask(change.name, names.index(change.name), data[change.name], change)
        for change in spec.changes
    ]
    return Scenario(
        name=spec.name,
        domain=spec.domain,
        backend=backend,
        reward=reward,
        environment=domain.environment,
        tasks=tuple(once * spec.repeats),
        distinct=len(names),
        interactions=spec.interactions,
        preset=spec.preset or spec.name,
    )


def register_scenario(spec: ScenarioSpec) -> None:
    """Registers `spec` by its name. Registering the same spec again is allowed.

    Raises:
      UserError: another scenario has this name, or `spec` is no `ScenarioSpec`.
    """
    _check_spec(spec)
    if SCENARIOS.get(spec.name, spec) != spec:
        raise UserError(f"There is another scenario named {spec.name!r}.")
    SCENARIOS[spec.name] = spec


def check_scenario(scenario: Any) -> None:
    """Raises `UserError` unless this is a `Scenario`."""
    if not isinstance(scenario, Scenario):
        raise UserError(
            f"scenario must be a Scenario, see make_scenario, not {scenario!r:.80}"
        )


def _check_spec(spec: Any) -> None:
    if not isinstance(spec, ScenarioSpec):
        raise UserError(f"a scenario must be a ScenarioSpec, not {spec!r:.80}")


def list_scenarios() -> tuple[str, ...]:
    """The names of all known scenarios, sorted."""
    return tuple(sorted(SCENARIOS))


_NORMAL = TaskChange("normal")
_INVERTED = TaskChange("inverted_actions", actions={"*": -1.0})
_HUGE_FEET = {"bfoot": 1.5, "ffoot": 1.5}
_TINY_FEET = {"bfoot": 0.5, "ffoot": 0.5}

_HALFCHEETAH = {
    change.name: change
    for change in (
        _NORMAL,
        _INVERTED,
        TaskChange("carry_stuff", bodies={"torso": 4.0}),
        TaskChange("carry_stuff_hugegravity", bodies={"torso": 4.0}, gravity=1.5),
        TaskChange("defective_module", hidden=0.5),
        TaskChange("hugefoot", bodies=_HUGE_FEET),
        TaskChange("hugefoot_rainfall", bodies=_HUGE_FEET, friction=0.4),
        TaskChange("tinyfoot", bodies=_TINY_FEET),
        TaskChange("tinyfoot_moon", bodies=_TINY_FEET, gravity=0.15),
        TaskChange("moon", gravity=0.15),
        TaskChange("rainfall", friction=0.4),
    )
}


def _without_legs(name: str, *legs: int) -> TaskChange:
    """Ant with dead legs: 1 front left, 2 front right, 3 back left, 4 back right."""
    joints = [f"{joint}_{leg}" for leg in legs for joint in ("hip", "ankle")]
    return TaskChange(name, actions=dict.fromkeys(joints, 0.0))


_ANT = {
    change.name: change
    for change in (
        _NORMAL,
        _INVERTED,
        TaskChange("hugefoot", bodies={f"lower_leg_{i}": 1.5 for i in (1, 2, 3, 4)}),
        TaskChange("moon", gravity=0.7),
        TaskChange("rainfall", friction=0.375),
        _without_legs("disabled_hard1", 2, 3, 4),
        _without_legs("disabled_hard2", 1, 3, 4),
        _without_legs("disabled_forefeet", 1, 2),
        _without_legs("disabled_backfeet", 3, 4),
        _without_legs("disabled_first_diagonal", 1, 3),
        _without_legs("disabled_second_diagonal", 2, 4),
    )
}

_HUMANOID = {
    change.name: change
    for change in (
        _NORMAL,
        TaskChange("moon", gravity=0.15),
        TaskChange("carrystuff", bodies={"torso": 4.0, "lwaist": 4.0}),
        TaskChange("tinyfeet", bodies={"right_shin": 0.5, "left_shin": 0.5}),
    )
}

# Consecutive goals are in opposite corners, so they conflict.
_REACH = {
    name: TaskChange(name, extra={"goal": goal})
    for name, goal in (
        ("northeast", (0.5, 0.5)),
        ("southwest", (-0.5, -0.5)),
        ("northwest", (-0.5, 0.5)),
        ("southeast", (0.5, -0.5)),
    )
}

# By domain: its tasks by name, repeats of each list, interactions a task.
_BRAX = {
    "halfcheetah": (_HALFCHEETAH, 2, 1_000_000),
    "ant": (_ANT, 2, 1_000_000),
    "humanoid": (_HUMANOID, 1, 2_000_000),
}


def _brax_spec(name: str, tasks: str) -> ScenarioSpec:
    domain = name.split("/")[0]
    known, repeats, interactions = _BRAX[domain]
    changes = tuple(known[task] for task in tasks.split())
    return ScenarioSpec(name, domain, changes, repeats, interactions)


def _continual_world_spec(name: str, tasks: str) -> ScenarioSpec:
    changes = tuple(TaskChange(task, extra={"task": task}) for task in tasks.split())
    return ScenarioSpec(f"continual_world/{name}", "metaworld", changes, 1, 1_000_000)


SCENARIOS: dict[str, ScenarioSpec] = {}
for _name, _tasks in (
    ("halfcheetah/forgetting", "hugefoot moon carry_stuff rainfall"),
    (
        "halfcheetah/transfer",
        "carry_stuff_hugegravity moon defective_module hugefoot_rainfall",
    ),
    ("halfcheetah/robustness", "normal inverted_actions normal inverted_actions"),
    (
        "halfcheetah/compositionality",
        "tinyfoot moon carry_stuff_hugegravity tinyfoot_moon",
    ),
    ("ant/forgetting", "normal hugefoot rainfall moon"),
    (
        "ant/transfer",
        "disabled_first_diagonal disabled_second_diagonal"
        " disabled_forefeet disabled_backfeet",
    ),
    ("ant/robustness", "normal inverted_actions normal inverted_actions"),
    (
        "ant/compositionality",
        "disabled_hard1 disabled_hard2 disabled_forefeet disabled_backfeet",
    ),
    ("humanoid/hard", "normal moon carrystuff tinyfeet"),
):
    register_scenario(_brax_spec(_name, _tasks))
for _name, _tasks in (
    ("t1", "push window-close hammer"),
    ("t2", "hammer window-close faucet-close"),
    ("t3", "window-close handle-press-side peg-unplug-side"),
    ("t4", "faucet-close shelf-place peg-unplug-side"),
    ("t5", "faucet-close shelf-place push-back"),
    ("t6", "stick-pull peg-unplug-side stick-pull"),
    ("t7", "stick-pull push-back push-wall"),
    ("t8", "push-wall shelf-place push-back"),
    (
        "cw10",
        "hammer push-wall faucet-close push-back stick-pull handle-press-side push"
        " shelf-place window-close peg-unplug-side",
    ),
):
    register_scenario(_continual_world_spec(_name, _tasks))
# Each single task, as the reference for forward transfer.
for _change in SCENARIOS["continual_world/cw10"].changes:
    register_scenario(_continual_world_spec(_change.name, _change.name))
register_scenario(
    ScenarioSpec("probe/reach", "reach", tuple(_REACH.values()), 1, 10_000)
)
