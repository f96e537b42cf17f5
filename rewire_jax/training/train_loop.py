"""One task's compiled loop: collect, store, update.

The functions are written for one member; callers vmap them. A vector step is one step
of each environment of a member. A round is the SAC updates that follow a vector step. A
chunk is the vector steps between two progress reports.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from rewire_jax.core.settings import SacSettings
from rewire_jax.envs.base import Environment, HostEnvironment, Task
from rewire_jax.methods.base import Method
from rewire_jax.methods.round import Round
from rewire_jax.training import (
    exploration,
    plasticity,
    random_keys,
    replay_buffer,
    rollout,
    sac,
    sac_updates,
)
from rewire_jax.training.loop_state import (
    ChunkMetrics,
    CollectorState,
    LoopConfig,
    RunnerState,
)
from rewire_jax.training.random_keys import CollectKeys, UpdateKeys


def select(condition: jax.Array, yes: Any, no: Any) -> Any:
    """Returns `yes` if the scalar condition holds, else `no`, for each leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def all_finite(tree: Any) -> jax.Array:
    """Returns `[]` bool: no leaf contains NaN or infinity."""
    # A sum is not finite if one of its terms is not.
    total = sum(jnp.sum(jnp.abs(leaf) * 1e-6) for leaf in jax.tree.leaves(tree))
    return jnp.isfinite(total)


def collect(
    key: jax.Array,
    state: RunnerState,
    task: Task,
    time: jax.Array,
    environment: Environment,
    method: Method,
    config: LoopConfig,
    sequence: jax.Array | None,
) -> tuple[CollectorState, rollout.Step]:
    """Makes one exploring vector step and stores it in the member's buffer.

    `key` is the step's key for collecting. `sequence` `[episode_length, envs, actions]`
    is coloured noise, None for white. The other arguments are those of `run_chunk`.
    """
    learner = state.learner
    buffer, episodes, extras = state.collection
    size = config.envs, environment.action_size
    action, extras = exploration.explore(
        exploration.sample_action_noise(key, time, size, config.random_steps, sequence),
        (learner.params, learner.method_state),
        extras,
        episodes.state.observation,
        episodes.steps,
        method,
    )
    length = environment.episode_length
    if environment.varied:
        # All episodes end at the same time, so `cond` computes the reset only then.
        reset_key = random_keys.named(CollectKeys, key).reset
        keys = jax.random.split(reset_key, config.envs)
        starts = jax.lax.cond(
            (time + 1) % length == 0,
            lambda: jax.vmap(lambda k: environment.reset(task, k))(keys),
            lambda: episodes.start,
        )
        episodes = episodes._replace(start=starts)
    advance = functools.partial(rollout.advance, environment, task)
    episodes, step = jax.vmap(advance)(episodes, action)
    buffer = store(buffer, time, action, extras, step, length)
    return CollectorState(buffer, episodes, extras), step


def store(
    buffer: replay_buffer.Replay,
    time: jax.Array,
    action: jax.Array,
    extras: Any,
    step: rollout.Step,
    episode_length: int,
) -> replay_buffer.Replay:
    """Adds a vector step to a member's buffer; see `replay_buffer.add`."""
    return replay_buffer.add(
        buffer,
        time,
        action=action,
        reward=step.reward,
        terminal=step.terminal,
        truncated=step.truncated,
        final_obs=step.final_obs,
        next_obs=step.next_obs,
        episode_length=episode_length,
        extras=extras,
    )


def no_metrics(
    state: RunnerState,
    environment: Environment | HostEnvironment,
    method: Method,
    settings: SacSettings,
) -> sac.Metrics:
    """Returns zeros with the shapes of the metrics of an update."""
    learner, buffer = state.learner, state.collection.buffer
    size = settings.batch_size, environment.action_size

    def first():
        key = jax.random.key(0)
        batch = replay_buffer.sample(
            buffer, key, jnp.asarray(1), size[0], environment.episode_length
        )
        draw = sac.sample_update_noise(
            key, learner.method_state, batch.extras, size, method, settings
        )
        return sac.first_metrics(learner, batch, draw, method, settings)

    shapes = jax.eval_shape(first)
    return jax.tree.map(jnp.zeros_like, shapes)


def update_from_buffer(
    key: jax.Array,
    state: RunnerState,
    time: jax.Array,
    before: jax.Array,
    due: jax.Array | bool,
    *,
    updates: int,
    environment: Environment | HostEnvironment,
    method: Method,
    settings: SacSettings,
) -> tuple[RunnerState, sac.Metrics]:
    """Makes a round of updates; also returns the metrics of the last update.

    If a parameter becomes NaN or infinite, the round is discarded and the member
    becomes inactive. One large random draw for all updates is faster than many small.

    Args:
      key: a random key.
      state: the member.
      time: `[]` int, vector steps made so far in this task.
      before: `[]` int, updates made before in this task; shared by all members.
      due: `[]` bool, shared by all members; if False, nothing is done.
      updates: number of updates in the round.
      environment: unbatched.
      method: the member's method.
      settings: SAC's settings.
    """
    buffer, length = state.collection.buffer, environment.episode_length
    size = settings.batch_size, environment.action_size

    def learned(learner):
        keys = random_keys.named(UpdateKeys, key)
        indices = replay_buffer.sample_indices(
            buffer, keys.indices, time, (updates, size[0])
        )
        draws = jax.vmap(
            lambda key, extras: sac.sample_update_noise(
                key, learner.method_state, extras, size, method, settings
            )
        )(
            jax.random.split(keys.draws, updates),
            replay_buffer.extras_at(buffer, indices, time),
        )

        def batch(number):
            return replay_buffer.take(buffer, indices[number], time, length)

        def fresh_batch(key):
            return replay_buffer.sample(buffer, key, time, size[0], length)

        group = sac_updates.group_size(updates, settings)
        learner, metrics = sac_updates.updates(
            learner, draws, batch, before, updates, method, settings, group
        )
        made = Round(before, before + updates, metrics)
        if settings.redo_every:
            learner = plasticity.redo_in_time(
                keys.redo, learner, fresh_batch, made, method, settings
            )
        learned = method.after_round(learner.params, learner.method_state, made)
        return learner.with_learned(learned), metrics

    # A loop with at most one iteration. All members share `due`, so vmap keeps it.
    learner, metrics = jax.lax.fori_loop(
        0,
        jnp.asarray(due, jnp.int32),
        lambda _, carry: learned(carry[0]),
        (state.learner, no_metrics(state, environment, method, settings)),
    )
    active = state.active & all_finite(
        (learner.params, learner.critic, learner.log_temperature)
    )
    learner = select(active, learner, state.learner)
    return state._replace(learner=learner, active=active), metrics


def run_chunk(
    key: jax.Array,
    state: RunnerState,
    task: Task,
    time: jax.Array,
    steps: jax.Array,
    *,
    environment: Environment,
    method: Method,
    settings: SacSettings,
    config: LoopConfig,
) -> tuple[RunnerState, ChunkMetrics]:
    """Collects and updates for a chunk.

    Args:
      key: the key for this task; with a step's number it determines the step's draws.
      state: the member.
      task: the current task.
      time: `[]` int, vector steps made before in this task; shared by all members.
      steps: `[]` int, vector steps to make; shared by all members.
      environment: unbatched.
      method: the member's method.
      settings: SAC's settings.
      config: static sizes.
    """
    color, length = settings.noise_color, environment.episode_length
    size = config.envs, environment.action_size

    def update(key, state, done):
        return update_from_buffer(
            key,
            state,
            done,
            config.before(done),
            config.due(done),
            updates=config.updates,
            environment=environment,
            method=method,
            settings=settings,
        )

    def step(index, carry):
        state, report, sequence = carry
        if sequence is not None:
            # The noise is not part of the state, so each chunk draws it again.
            sequence = jax.lax.cond(
                (index % length == 0) | (index == time),
                lambda: exploration.sample_colored(key, index, size, length, settings),
                lambda: sequence,
            )
        keys = random_keys.of_step(key, index)
        collection, stepped = collect(
            keys.collect, state, task, index, environment, method, config, sequence
        )
        state = state._replace(collection=collection)
        state, metrics = update(keys.update, state, index + 1)
        ended = stepped.terminal | stepped.truncated
        report = ChunkMetrics(
            report.episodes + jnp.sum(ended),
            report.returns + jnp.sum(jnp.where(ended, stepped.score, 0.0)),
            report.rewards + jnp.mean(stepped.reward),
            report.updates + config.due(index + 1),
            jax.tree.map(jnp.add, report.metrics, metrics),
            {},
            jax.tree.map(
                lambda total, solved: total + jnp.sum(ended & solved),
                report.successes,
                stepped.success,
            ),
        )
        return state, report, sequence

    none = jnp.zeros(())
    report = ChunkMetrics(
        jnp.zeros((), jnp.int32),
        none,
        none,
        none,
        no_metrics(state, environment, method, settings),
        {},
        rollout.Success(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))
        if environment.success
        else (),
    )
    end = time + steps
    sequence = jnp.zeros((length, *size)) if color else None
    carry = state, report, sequence
    state, report, _ = jax.lax.fori_loop(time, end, step, carry)
    inspected = inspect(key, state, end, length, method, settings)
    return state, report._replace(inspected=inspected)


def inspect(
    key: jax.Array,
    state: RunnerState,
    time: jax.Array,
    length: int,
    method: Method,
    settings: SacSettings,
) -> sac.Metrics:
    """Returns metrics of the learner on a batch; `length` is the episode length."""
    batch_key = random_keys.of_step(key, time).inspect
    buffer, learner = state.collection.buffer, state.learner
    batch = replay_buffer.sample(buffer, batch_key, time, settings.batch_size, length)
    metrics = method.inspect(learner.params, learner.method_state, batch.observation)
    if not settings.plasticity_metrics:
        return metrics
    return metrics | plasticity.metrics(learner, batch, method, settings)
