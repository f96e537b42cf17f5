"""The compiled functions of a run, over a whole population."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from rewire_jax.core import kept_programs
from rewire_jax.core.arguments import require
from rewire_jax.envs.base import Environment, HostEnvironment, Task
from rewire_jax.methods import segments
from rewire_jax.methods.base import Candidates, CandidateScore, Method
from rewire_jax.training import host_train_loop, population, rollout, sac
from rewire_jax.training.loop_state import ChunkMetrics, RunnerState
from rewire_jax.training.member_functions import MemberFunctions


class Program(NamedTuple):
    """The compiled functions of a run; the first axis of all is `[members]`.

    A function is traced once, whatever the task: tasks and times are data.

    Attributes:
      init: `members -> TrainState`.
      begin: `(members, learner, active, index, task) -> RunnerState`, a task's start.
      start: `(members, learner, active, index, episodes) -> RunnerState`, the same in
        running environments `[members, envs]`.
      change_task: `(members, state, number, time, task) -> state`, changes the task of
        the environments alone; the given state is used up.
      after_baseline: `(members, state, before) -> state`, after the candidates' rollout
        at a task's start; the given state is used up; or None.
      chunk: `(members, state, index, task, time, steps) -> state, ChunkMetrics`, takes
        `steps` vector steps; the given state is used up.
      consolidate: `(members, state, index, time) -> TrainState`, the end of a task's
        interactions, `time` vector steps; or None.
      offline_update: `(members, state, index, time, done, steps) -> state`, updates
        from the buffer as in `steps` steps, `done` of which were made before.
      candidates: `(members, learner, index) -> Candidates`, or None.
      finish: `(members, learner, index, Selection or None) -> TrainState`.
      policies: `(members, learner) -> policies [members, tasks]`; without the second
        axis what is `Shared`.
      rollout: `(tasks, policies, keys, count) -> Rollout`, see `rollout.episodes`.
      trial: the same for candidates, see `Method.candidate_score`.
      state_shape: what `begin` gives for the same arguments, as shapes.
      traces: `() -> int`, how often a function that trains was traced so far.
      size: `(members, learner) -> [members], [members]`, numbers stored, and numbers of
        stored states.
      baseline: whether candidates are rolled out at a task's start, too.
    """

    init: Callable[..., sac.TrainState]
    begin: Callable[..., RunnerState]
    start: Callable[..., RunnerState]
    change_task: Callable[..., RunnerState]
    after_baseline: Callable[..., RunnerState] | None
    chunk: Callable[..., tuple[RunnerState, ChunkMetrics]]
    consolidate: Callable[..., sac.TrainState] | None
    offline_update: Callable[..., RunnerState]
    candidates: Callable[..., Candidates] | None
    finish: Callable[..., sac.TrainState]
    policies: Callable[..., Any]
    rollout: Callable[..., rollout.Rollout]
    trial: Callable[..., rollout.Rollout]
    state_shape: Callable[..., RunnerState]
    traces: Callable[[], int]
    size: Callable[..., tuple[jax.Array, jax.Array]]
    baseline: bool


@functools.lru_cache
def rollout_function(
    environment: Environment,
    act: Callable[..., Any],
    rows: int,
    count: int,
    mesh: Mesh,
    score: CandidateScore,
    name: str,
) -> Callable[..., rollout.Rollout]:
    """`(tasks, policies, keys) -> Rollout` for fixed sizes, see `rollout.episodes`.

    Methods whose policies are computed alike share one compiled function, unless its
    program is kept: that has a name.
    """
    play = rollout.PLAYS[score]

    def episodes(tasks: Task, policies: Any, keys: jax.Array) -> rollout.Rollout:
        assert keys.shape[1] == rows
        return play(environment, act, tasks, policies, keys, count)

    name = name and f"{name} rollout {rows} {count} {score}"
    return population.compiled(episodes, (None, 0, 0), mesh, name=name)


@functools.lru_cache
def build(of: MemberFunctions, example: Any, mesh: Mesh) -> Program:
    """The functions of a run; runs alike in all but numbers share them.

    Args:
      of: what a run does with one member.
      example: one member's method settings, for what is static about the method.
      mesh: the devices among which the members are shared out.
    """
    method = segments.build(of.make, of.spec, example)
    traces = population.Traces()
    name = _name(of, example)
    loop, trial = _loop(of, method, mesh, traces, name)
    over = functools.partial(_over, mesh, name)
    return Program(
        init=over(of.init, 0),
        start=over(of.start, 0, 0, 0, None, 0),
        change_task=over(of.change_task, 0, 0, None, None, None, donate=(1,)),
        after_baseline=over(of.after_baseline, 0, 0, 0, donate=(1,))
        if method.after_baseline
        else None,
        consolidate=over(of.consolidate, 0, 0, None, None)
        if method.consolidate
        else None,
        offline_update=over(
            of.offline_update,
            0,
            0,
            None,
            None,
            None,
            None,
            donate=(1,),
            traces=traces,
        ),
        candidates=over(of.candidates, 0, 0, None) if method.candidates else None,
        finish=over(of.finish, 0, 0, None, 0),
        policies=over(of.policies, 0, 0),
        size=over(of.size, 0, 0),
        baseline=method.baseline,
        trial=trial,
        traces=lambda: traces.count,
        **loop._asdict(),
    )


def _name(of: MemberFunctions, example: Any) -> str:
    """What the functions of a run compute, see `kept_programs`; empty if unknown."""
    environment = of.environment
    if isinstance(environment, HostEnvironment) or not kept_programs.programs_kept():
        return ""
    domain = kept_programs.common_name(environment.reset, environment.step)
    method = kept_programs.common_name(of.make)
    if not domain or not method:
        return ""
    functions = "reset", "step", "film"
    rest = [v for k, v in environment._asdict().items() if k not in functions]
    statics = jax.tree.structure(example)
    return f"{domain} {rest} {method} {of.spec} {of.config} {statics}"


def _over(
    mesh: Mesh, name: str, function: Callable[..., Any], *axes: int | None, **how: Any
) -> Callable[..., Any]:
    """`population.over`, with the name of a run's function."""
    name = name and f"{name} {function.__name__}"
    return population.over(mesh, function, *axes, name=name, **how)


def _loop(
    of: MemberFunctions,
    method: Method,
    mesh: Mesh,
    traces: population.Traces,
    name: str,
) -> tuple[host_train_loop.Loop, Callable[..., rollout.Rollout]]:
    """The functions that step environments, and `Program.trial`."""
    environment = of.environment
    if isinstance(environment, HostEnvironment):
        require(
            method.candidate_score == "episode",
            "--candidate-score since_reset: environments that are stepped on the host "
            "are scored only by whole episodes",
        )
        loop = host_train_loop.loop(of, method.act, mesh, traces)
        return loop, loop.rollout

    act: Callable[..., Any] = method.act

    def play(score: CandidateScore) -> Callable[..., rollout.Rollout]:
        def episodes(tasks, policies, keys, count):
            sizes = keys.shape[1], count, mesh, score
            function = rollout_function(environment, act, *sizes, name)
            return function(tasks, policies, keys)

        return episodes

    over = functools.partial(_over, mesh, name)
    begins = over(of.begin, 0, 0, 0, None, None)
    trains = over(of.chunk, 0, 0, None, None, None, None, donate=(1,), traces=traces)
    loop = host_train_loop.Loop(
        begin=begins,
        chunk=trains,
        rollout=play("episode"),
        state_shape=functools.partial(jax.eval_shape, begins),
    )
    return loop, play(method.candidate_score)
