"""One task's compiled loop: collect, store, update, for a whole population."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax import networks, replay, rollout, sac
from rewire_jax.config import SacSettings
from rewire_jax.envs.base import Environment, Task
from rewire_jax.methods.base import Candidates, Method, Selection, Spec


class Shape(NamedTuple):
    """Static sizes of the loop.

    Attributes:
      envs: parallel environments of a member.
      updates: SAC updates after each step of all environments.
      warmup: steps of all environments before the first update.
      random: steps of all environments with uniform actions.
      transitions: steps of all environments that the buffer holds.
    """

    envs: int
    updates: int
    warmup: int
    random: int
    transitions: int


class Collection(NamedTuple):
    """What collecting changes within a task.

    Attributes:
      buffer: the replay buffer.
      episodes: `[envs]` environments.
    """

    buffer: replay.Replay
    episodes: rollout.Episode


class State(NamedTuple):
    """A member in the middle of a task.

    Attributes:
      learner: all that learning changes.
      collection: all that collecting changes.
      alive: `[]` bool; once a value is not finite the learner stays as it was.
    """

    learner: sac.Learner
    collection: Collection
    alive: jax.Array


class Report(NamedTuple):
    """What happened in a chunk.

    Attributes:
      episodes: `[]`, training episodes that ended.
      returns: `[]`, the sum of their returns.
      rewards: `[]`, the sum over steps of the mean reward of all environments.
      updates: `[]`, steps with updates.
      metrics: sums over these steps, of each one's last update.
    """

    episodes: jax.Array
    returns: jax.Array
    rewards: jax.Array
    updates: jax.Array
    metrics: sac.Metrics


class Program(NamedTuple):
    """The compiled functions of a run; the first axis of all is `[members]`.

    A function is traced once, whatever the task: tasks and times are data.

    Attributes:
      init: `members -> Learner`.
      begin: `(members, learner, alive, index, task) -> State`, a task's start.
      chunk: `(members, state, index, task, time, steps) -> state, Report`, takes
        `steps` steps of all environments; the given state is used up.
      candidates: `(members, learner, index) -> Candidates`, or None.
      finish: `(members, learner, index, Selection or None) -> Learner`.
      policies: `(members, learner) -> policies [members, tasks]`.
      rollout: `(tasks, policies, keys, count) -> Rollout`, see `rollout.episodes`.
      size: `(members, learner) -> [members]`, numbers stored.
    """

    init: Callable[..., sac.Learner]
    begin: Callable[..., State]
    chunk: Callable[..., tuple[State, Report]]
    candidates: Callable[..., Candidates] | None
    finish: Callable[..., sac.Learner]
    policies: Callable[..., Any]
    rollout: Callable[..., rollout.Rollout]
    size: Callable[..., jax.Array]


def select(condition: jax.Array, yes: Any, no: Any) -> Any:
    """`yes` where the scalar condition holds, else `no`, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def all_finite(tree: Any) -> jax.Array:
    """`[]` bool, no leaf holds a NaN or an infinity."""
    # A sum is not finite as soon as one term is not.
    total = sum(jnp.sum(jnp.abs(leaf) * 1e-6) for leaf in jax.tree.leaves(tree))
    return jnp.isfinite(total)


def collect(
    key: jax.Array,
    state: State,
    task: Task,
    time: jax.Array,
    environment: Environment,
    method: Method,
    shape: Shape,
) -> tuple[Collection, rollout.Step]:
    """One exploring step of all environments of a member, stored in its buffer."""
    learner, (buffer, episodes), _ = state
    context_key, action_key, random_key = jax.random.split(key, 3)
    context = method.context(context_key, learner.memory, False)
    mean, log_std = method.distribution(
        learner.params, learner.memory, context, episodes.state.observation
    )
    action, _ = networks.sample_action(action_key, mean, log_std)
    if shape.random:
        uniform = jax.random.uniform(random_key, action.shape, minval=-1.0)
        action = jnp.where(time < shape.random, uniform, action)
    advance = functools.partial(rollout.advance, environment, task)
    episodes, step = jax.vmap(advance)(episodes, action)
    buffer = replay.add(
        buffer,
        time,
        action=action,
        reward=step.reward,
        terminal=step.terminal,
        truncated=step.truncated,
        last=step.last,
        following=step.following,
        episode_length=environment.episode_length,
    )
    return Collection(buffer, episodes), step


def train(
    key: jax.Array,
    state: State,
    task: Task,
    time: jax.Array,
    steps: jax.Array,
    *,
    environment: Environment,
    method: Method,
    settings: SacSettings,
    shape: Shape,
) -> tuple[State, Report]:
    """Collects and learns for some steps; one member.

    Args:
      key: the task's key; a step's randomness follows from it and the time alone.
      state: the member.
      task: the current task.
      time: `[]` int, steps of all environments made before in this task. It and
        `steps` must be shared by all members.
      steps: `[]` int, steps to make.
      environment: unbatched.
      method: the method.
      settings: SAC's.
      shape: static sizes.
    """

    def draw(key, buffer, time):
        return replay.sample(
            buffer, key, time, settings.batch_size, environment.episode_length
        )

    def step(index, carry):
        state, report = carry
        collect_key, update_key = jax.random.split(jax.random.fold_in(key, index))
        collection, stepped = collect(
            collect_key, state, task, index, environment, method, shape
        )
        updates = jnp.where(index >= shape.warmup, shape.updates, 0)

        def one(number, carry):
            learner, metrics = carry
            sample_key, key = jax.random.split(jax.random.fold_in(update_key, number))
            batch = draw(sample_key, collection.buffer, index + 1)
            count = (index - shape.warmup) * shape.updates + number
            return sac.update(learner, metrics, batch, key, count, method, settings)

        learner, metrics = jax.lax.fori_loop(0, updates, one, (state.learner, zeros))
        alive = state.alive & all_finite(
            (learner.params, learner.critic, learner.log_temperature)
        )
        learner = select(alive, learner, state.learner)
        ended = stepped.terminal | stepped.truncated
        report = Report(
            report.episodes + jnp.sum(ended),
            report.returns + jnp.sum(jnp.where(ended, stepped.score, 0.0)),
            report.rewards + jnp.mean(stepped.reward),
            report.updates + (updates > 0),
            jax.tree.map(jnp.add, report.metrics, metrics),
        )
        return State(learner, collection, alive), report

    batch = draw(key, state.collection.buffer, jnp.asarray(1))
    zeros = sac.policy_metrics(state.learner, batch, method, settings)
    zeros |= {"critic_loss": jnp.zeros(()), "q": jnp.zeros(())}
    none = jnp.zeros(())
    report = Report(jnp.zeros((), jnp.int32), none, none, none, zeros)
    return jax.lax.fori_loop(time, time + steps, step, (state, report))


@functools.lru_cache
def rollout_function(
    environment: Environment, act: Callable[..., Any], rows: int, count: int
) -> Callable[..., rollout.Rollout]:
    """`(tasks, policies, keys) -> Rollout` for fixed sizes, see `rollout.episodes`.

    Methods whose policies are computed alike share one compiled function.
    """

    def episodes(tasks: Task, policies: Any, keys: jax.Array) -> rollout.Rollout:
        assert keys.shape[1] == rows
        return rollout.episodes(environment, act, tasks, policies, keys, count)

    return jax.jit(episodes)


@functools.lru_cache
def build(
    environment: Environment,
    make: Callable[[Spec, Any], Method],
    spec: Spec,
    shape: Shape,
    example: Any,
) -> Program:
    """The functions of a run; runs alike in all but numbers share them.

    Args:
      environment: of the scenario.
      make: the method's constructor.
      spec: sizes of the networks and of the sequence.
      shape: sizes of the loop.
      example: one member's method settings, for what is static about the method.
    """

    def init(member):
        key = jax.random.fold_in(member.keys, 0)
        return sac.init(key, make(spec, member.options), spec, member.sac)

    def task_keys(member, index):
        # One for the start, one for the steps. A key is either split or folded,
        # never both: `split(key)[i]` is the same key as `fold_in(key, i)`.
        key = jax.random.fold_in(jax.random.fold_in(member.keys, 1), index)
        return jax.random.split(key)

    def begin(member, learner, alive, index, task):
        method = make(spec, member.options)
        start_key, reset_key = jax.random.split(task_keys(member, index)[0])
        params, memory = method.start_task(
            start_key, learner.params, learner.memory, index
        )
        learner = learner._replace(params=params, memory=memory)
        keys = jax.random.split(reset_key, shape.envs)
        episodes = jax.vmap(lambda k: rollout.begin(environment, task, k))(keys)
        buffer = replay.create(
            episodes.state.observation,
            transitions=shape.transitions,
            actions=spec.actions,
            episode_length=environment.episode_length,
        )
        learner = sac.restart(learner, member.sac)
        return State(learner, Collection(buffer, episodes), alive)

    def chunk(member, state, index, task, time, steps):
        return train(
            task_keys(member, index)[1],
            state,
            task,
            time,
            steps,
            environment=environment,
            method=make(spec, member.options),
            settings=member.sac,
            shape=shape,
        )

    def candidates(member, learner, index):
        method = make(spec, member.options)
        assert method.candidates is not None
        return method.candidates(learner.params, learner.memory, index)

    def finish(member, learner, index, selection: Selection | None):
        method = make(spec, member.options)
        params, memory = method.end_task(
            learner.params, learner.memory, index, selection
        )
        return learner._replace(params=params, memory=memory)

    def policies(member, learner):
        method = make(spec, member.options)
        policy = functools.partial(method.policy, learner.params, learner.memory)
        return jax.vmap(policy)(jnp.arange(spec.tasks))

    def rollout_episodes(tasks, policies, keys, count):
        function = rollout_function(environment, method.act, keys.shape[1], count)
        return function(tasks, policies, keys)

    def size(member, learner):
        return make(spec, member.options).size(learner.params, learner.memory)

    method = make(spec, example)
    chunk_axes = (0, 0, None, None, None, None)
    return Program(
        init=jax.jit(jax.vmap(init)),
        begin=jax.jit(jax.vmap(begin, (0, 0, 0, None, None))),
        chunk=jax.jit(jax.vmap(chunk, chunk_axes), donate_argnums=1),
        candidates=method.candidates and jax.jit(jax.vmap(candidates, (0, 0, None))),
        finish=jax.jit(jax.vmap(finish, (0, 0, None, 0))),
        policies=jax.jit(jax.vmap(policies)),
        rollout=rollout_episodes,
        size=jax.jit(jax.vmap(size)),
    )
