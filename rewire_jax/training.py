"""One task's compiled loop: collect, store, update, for a whole population."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewire_jax import networks, noise, replay, rollout, sac
from rewire_jax.config import SacSettings
from rewire_jax.envs.base import Environment, Task
from rewire_jax.methods.base import Method


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
      label: the method's, of the latest step.
    """

    buffer: replay.Replay
    episodes: rollout.Episode
    label: Any


class State(NamedTuple):
    """A member in the middle of a task.

    Attributes:
      learner: all that learning changes.
      collection: all that collecting changes.
      alive: `[]` bool; once a value is not finite the learner is updated no more.
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
      inspected: the method's own metrics at the end.
    """

    episodes: jax.Array
    returns: jax.Array
    rewards: jax.Array
    updates: jax.Array
    metrics: sac.Metrics
    inspected: sac.Metrics


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
    sequence: jax.Array | None,
) -> tuple[Collection, rollout.Step]:
    """One exploring step of all environments of a member, stored in its buffer.

    `sequence` is the coloured noise that `time` lies in, None where noise is white.
    """
    learner, (buffer, episodes, label), _ = state
    context_key, action_key, random_key, label_key = jax.random.split(key, 4)
    label = method.label(label_key, learner.memory, label, episodes.steps)
    context = method.context(context_key, learner.memory, "act", label)
    mean, log_std = method.distribution(
        learner.params, learner.memory, context, episodes.state.observation
    )
    if sequence is None:
        action, _ = networks.sample_action(action_key, mean, log_std)
    else:
        action = jnp.tanh(mean + jnp.exp(log_std) * sequence[time % len(sequence)])
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
        label=label,
    )
    return Collection(buffer, episodes, label), step


def draw_batch(
    key: jax.Array,
    state: State,
    time: jax.Array,
    environment: Environment,
    settings: SacSettings,
) -> replay.Batch:
    """A batch from a member's buffer of `time` steps."""
    buffer, length = state.collection.buffer, environment.episode_length
    return replay.sample(buffer, key, time, settings.batch_size, length)


def learn(
    key: jax.Array,
    state: State,
    time: jax.Array,
    first: jax.Array,
    updates: jax.Array | int,
    *,
    environment: Environment,
    method: Method,
    settings: SacSettings,
) -> tuple[State, sac.Metrics]:
    """Updates from a member's buffer, and the last one's metrics.

    Args:
      key: a random key.
      state: the member.
      time: `[]` int, steps of all environments in the buffer.
      first: `[]` int, updates made before; shared by all members.
      updates: how many.
      environment: unbatched.
      method: the method.
      settings: SAC's.
    """

    def draw(key):
        return draw_batch(key, state, time, environment, settings)

    def one(number, carry):
        learner, metrics = carry
        sample_key, update_key = jax.random.split(jax.random.fold_in(key, number))
        return sac.update(
            learner,
            metrics,
            draw(sample_key),
            update_key,
            first + number,
            method,
            settings,
        )

    zeros = sac.policy_metrics(state.learner, draw(key), method, settings)
    zeros |= {"critic_loss": jnp.zeros(()), "q": jnp.zeros(())}
    learner, metrics = jax.lax.fori_loop(0, updates, one, (state.learner, zeros))
    alive = state.alive & all_finite(
        (learner.params, learner.critic, learner.log_temperature)
    )
    learner = select(alive, learner, state.learner)
    return state._replace(learner=learner, alive=alive), metrics


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
    update = functools.partial(
        learn, environment=environment, method=method, settings=settings
    )
    color, length = settings.noise_color, environment.episode_length
    size = shape.envs, environment.action_size

    def draw_sequence(index):
        # As long as an episode. A key that the steps do not use.
        start_key = jax.random.fold_in(key, index - index % length)
        sequence_key = jax.random.split(start_key, 4)[3]
        return noise.colored(sequence_key, color, length, size)

    def step(index, carry):
        state, report, sequence = carry
        if sequence is not None:
            # It is not part of the state: a chunk draws it anew.
            due = (index % length == 0) | (index == time)
            sequence = jax.lax.cond(due, draw_sequence, lambda _: sequence, index)
        collect_key, update_key = jax.random.split(jax.random.fold_in(key, index))
        collection, stepped = collect(
            collect_key, state, task, index, environment, method, shape, sequence
        )
        state = state._replace(collection=collection)
        updates = jnp.where(index >= shape.warmup, shape.updates, 0)
        first = (index - shape.warmup) * shape.updates
        state, metrics = update(update_key, state, index + 1, first, updates)
        ended = stepped.terminal | stepped.truncated
        report = Report(
            report.episodes + jnp.sum(ended),
            report.returns + jnp.sum(jnp.where(ended, stepped.score, 0.0)),
            report.rewards + jnp.mean(stepped.reward),
            report.updates + (updates > 0),
            jax.tree.map(jnp.add, report.metrics, metrics),
            {},
        )
        return state, report, sequence

    _, shapes = jax.eval_shape(update, key, state, time, time, 1)
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    none = jnp.zeros(())
    report = Report(jnp.zeros((), jnp.int32), none, none, none, zeros, {})
    end = time + steps
    sequence = jnp.zeros((length, *size)) if color else None
    carry = state, report, sequence
    state, report, _ = jax.lax.fori_loop(time, end, step, carry)
    # A key that the next step does not use.
    batch_key = jax.random.split(jax.random.fold_in(key, end), 3)[2]
    batch = draw_batch(batch_key, state, end, environment, settings)
    params, memory = state.learner.params, state.learner.memory
    inspected = method.inspect(params, memory, batch.observation)
    return state, report._replace(inspected=inspected)
