"""The compiled functions of a run, over a whole population."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from rewire_jax.core.settings import require
from rewire_jax.envs.base import Environment, HostEnvironment, Task
from rewire_jax.methods.base import (
    Candidates,
    CandidateScore,
    Method,
    Selection,
    Spec,
    Tools,
    axes,
)
from rewire_jax.training import (
    host_train_loop,
    population,
    replay_buffer,
    rollout,
    sac,
    train_loop,
)
from rewire_jax.training.train_loop import (
    ChunkMetrics,
    CollectorState,
    LoopConfig,
    RunnerState,
)


class Program(NamedTuple):
    """The compiled functions of a run; the first axis of all is `[members]`.

    A function is traced once, whatever the task: tasks and times are data.

    Attributes:
      init: `members -> TrainState`.
      begin: `(members, learner, active, index, task) -> State`, a task's start.
      chunk: `(members, state, index, task, time, steps) -> state, Report`, takes
        `steps` steps of all environments; the given state is used up.
      consolidate: `(members, state, index, time) -> TrainState`, the end of a task's
        interactions, `time` steps of all environments; or None.
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
      size: `(members, learner) -> [members]`, numbers stored.
      baseline: whether candidates are rolled out at a task's start, too.
    """

    init: Callable[..., sac.TrainState]
    begin: Callable[..., RunnerState]
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
    size: Callable[..., jax.Array]
    baseline: bool


@functools.lru_cache
def rollout_function(
    environment: Environment,
    act: Callable[..., Any],
    rows: int,
    count: int,
    mesh: Mesh,
    score: CandidateScore,
) -> Callable[..., rollout.Rollout]:
    """`(tasks, policies, keys) -> Rollout` for fixed sizes, see `rollout.episodes`.

    Methods whose policies are computed alike share one compiled function.
    """
    play = rollout.PLAYS[score]

    def episodes(tasks: Task, policies: Any, keys: jax.Array) -> rollout.Rollout:
        assert keys.shape[1] == rows
        return play(environment, act, tasks, policies, keys, count)

    return population.compiled(episodes, (None, 0, 0), mesh)


@functools.lru_cache
def build(
    environment: Environment | HostEnvironment,
    make: Callable[[Spec, Any], Method],
    spec: Spec,
    shape: LoopConfig,
    example: Any,
    mesh: Mesh,
) -> Program:
    """The functions of a run; runs alike in all but numbers share them.

    Args:
      environment: of the scenario.
      make: the method's constructor.
      spec: sizes of the networks and of the sequence.
      shape: sizes of the loop.
      example: one member's method settings, for what is static about the method.
      mesh: the devices among which the members are shared out.
    """

    def init(member):
        key = jax.random.fold_in(member.keys, 0)
        return sac.init(key, make(spec, member.options), spec, member.sac)

    def task_keys(member, index):
        # For the start, the steps, consolidation and updates after it. A key is either
        # split or folded, never both: `split(key)[i]` is the same as `fold_in(key, i)`.
        key = jax.random.fold_in(jax.random.fold_in(member.keys, 1), index)
        return jax.random.split(key, 4)

    def start(member, learner, active, index, episodes):
        method = make(spec, member.options)
        keys = jax.random.split(task_keys(member, index)[0], 4)
        start_key, _, critic_key, extras_key = keys
        params, method_state = method.start_task(
            start_key, learner.params, learner.method_state, index
        )
        learner = learner._replace(params=params, method_state=method_state)
        if method.fresh_critic:
            critic = sac.init_critic(critic_key, spec, method.critic_extra)
            learner = learner._replace(critic=critic)
        extras = method.extras(extras_key, method_state, None, episodes.steps)
        buffer = replay_buffer.create(
            episodes.state.observation,
            transitions=shape.transitions,
            actions=spec.actions,
            episode_length=environment.episode_length,
            extras=extras,
        )
        learner = sac.restart(learner, member.sac)
        acting = (learner.params, learner.method_state) if shape.overlap else ()
        return RunnerState(
            learner, CollectorState(buffer, episodes, extras), active, acting
        )

    def consolidate(member, state, index, time):
        method = make(spec, member.options)
        assert method.consolidate is not None
        learner, buffer = state.learner, state.collection.buffer

        def sample(key, count):
            return replay_buffer.sample(
                buffer, key, time, count, environment.episode_length
            )

        def q(context, observation, action):
            inputs = method.critic_input(context, observation)
            return sac.q_values(learner.critic, inputs, action)

        key = task_keys(member, index)[2]
        params, method_state = method.consolidate(
            key, learner.params, learner.method_state, index, Tools(sample, q)
        )
        learner = learner._replace(params=params, method_state=method_state)
        return sac.restart(learner, member.sac)

    def offline_update(member, state, index, time, done, steps):
        method = make(spec, member.options)
        update = functools.partial(
            train_loop.update_from_buffer,
            due=True,
            updates=shape.updates,
            environment=environment,
            method=method,
            settings=method.offline_sac(member.sac),
        )
        key = task_keys(member, index)[3]

        def step(number, state):
            first = number * shape.updates
            step_key = jax.random.fold_in(key, number)
            return update(step_key, state, time, first)[0]

        return jax.lax.fori_loop(done, done + steps, step, state)

    def candidates(member, learner, index):
        method = make(spec, member.options)
        assert method.candidates is not None
        return method.candidates(learner.params, learner.method_state, index)

    def finish(member, learner, index, selection: Selection | None):
        method = make(spec, member.options)
        params, method_state = method.end_task(
            learner.params, learner.method_state, index, selection
        )
        return learner._replace(params=params, method_state=method_state)

    def policies(member, learner):
        method = make(spec, member.options)
        policy = functools.partial(method.policy, learner.params, learner.method_state)
        tasks = jnp.arange(spec.tasks)
        out_axes = axes(jax.eval_shape(policy, tasks[0]))
        return jax.vmap(policy, out_axes=out_axes)(tasks)

    def size(member, learner):
        return make(spec, member.options).size(learner.params, learner.method_state)

    over = functools.partial(population.over, mesh)

    def method_of(member):
        return make(spec, member.options)

    method = make(spec, example)
    parts = method_of, method.act, task_keys, start, shape, mesh
    if isinstance(environment, HostEnvironment):
        require(
            method.candidate_score == "episode",
            "--candidate-score since_reset: environments that are stepped on the host "
            "are scored by whole episodes alone",
        )
        loop = host_train_loop.loop(environment, *parts)
        trial = loop.rollout
    else:
        loop = _loop(environment, *parts)

        def trial(tasks, policies, keys, count):
            sizes = keys.shape[1], count, mesh, method.candidate_score
            return rollout_function(environment, method.act, *sizes)(
                tasks, policies, keys
            )

    return Program(
        init=over(init, 0),
        consolidate=method.consolidate and over(consolidate, 0, 0, None, None),
        offline_update=over(offline_update, 0, 0, None, None, None, None, donate=(1,)),
        candidates=method.candidates and over(candidates, 0, 0, None),
        finish=over(finish, 0, 0, None, 0),
        policies=over(policies, 0, 0),
        size=over(size, 0, 0),
        baseline=method.baseline,
        trial=trial,
        **loop._asdict(),
    )


def _loop(
    environment: Environment,
    make: Callable[[Any], Method],
    act: Callable[..., Any],
    task_keys: Callable[[Any, Any], jax.Array],
    start: Callable[..., RunnerState],
    shape: LoopConfig,
    mesh: Mesh,
) -> host_train_loop.Loop:
    """The same as `host_train_loop.loop` of an environment that is compiled, too."""

    def begin(member, learner, active, index, task):
        reset_key = jax.random.split(task_keys(member, index)[0], 4)[1]
        keys = jax.random.split(reset_key, shape.envs)
        episodes = jax.vmap(lambda k: rollout.begin(environment, task, k))(keys)
        return start(member, learner, active, index, episodes)

    def chunk(member, state, index, task, time, steps):
        return train_loop.train(
            task_keys(member, index)[1],
            state,
            task,
            time,
            steps,
            environment=environment,
            method=make(member),
            settings=member.sac,
            shape=shape,
        )

    over = functools.partial(population.over, mesh)

    def episodes(tasks, policies, keys, count):
        rows = keys.shape[1]
        function = rollout_function(environment, act, rows, count, mesh, "episode")
        return function(tasks, policies, keys)

    begins = over(begin, 0, 0, 0, None, None)
    trains = over(chunk, 0, 0, None, None, None, None, donate=(1,))
    return host_train_loop.Loop(
        begin=begins,
        chunk=trains,
        rollout=episodes,
        state_shape=functools.partial(jax.eval_shape, begins),
        traces=trains._cache_size,  # type: ignore[attr-defined]
    )
