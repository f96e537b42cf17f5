"""The training loop of a task for environments that the host steps.

It makes the same steps, updates and random draws as `train_loop.run_chunk`.
"""

# The records below have JAX arrays as types; here they contain NumPy arrays.
# mypy: disable-error-code="arg-type"

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from numpy.typing import NDArray

from rewire_jax.envs.base import HostEnvironment, Task
from rewire_jax.envs.vector_env import open_lanes, shown
from rewire_jax.training import (
    exploration,
    host_episodes,
    population,
    random_keys,
    train_loop,
)
from rewire_jax.training.host_rollout import play
from rewire_jax.training.loop_state import (
    ChunkMetrics,
    CollectorState,
    LoopConfig,
    RunnerState,
)
from rewire_jax.training.member_functions import MemberFunctions
from rewire_jax.training.population import Members
from rewire_jax.training.rollout import Rollout, Step

Array = NDArray[Any]


class Loop(NamedTuple):
    """The functions that step environments; see `compiled_functions.Program`."""

    begin: Callable[..., RunnerState]
    chunk: Callable[..., tuple[RunnerState, ChunkMetrics]]
    rollout: Callable[..., Rollout]
    state_shape: Callable[..., RunnerState]


class _Functions(NamedTuple):
    """The compiled functions; the first axis of all is `[members]`.

    Attributes:
      roots: `(members, index) -> [members, 2]` uint32, for the seeds of episodes.
      begin: `(members, learner, active, index, episodes) -> RunnerState`.
      draws: `(members, index, time) -> ActionNoise` `[members, every]`, of the
        next steps. To draw for each single step would take half of an action's time.
      act: `(members, draws, number, acting, extras, observation, steps) -> actions,
        extras`, by the draw with that number; on the CPU, where it waits for no other
        device's updates.
      store_and_update: `(members, learner, buffer, active, index, time, played) ->
        learner, buffer, active, metrics`, stores `LoopConfig.update_every` steps and
        makes the round of updates that is due after them. Its arguments are donated,
        except the learner with overlap.
      inspect: `(members, learner, buffer, index, time) -> metrics`.
    """

    roots: Callable[..., jax.Array]
    begin: Callable[..., RunnerState]
    draws: Callable[..., exploration.ActionNoise]
    act: Callable[..., tuple[jax.Array, Any]]
    store_and_update: Callable[..., tuple[Any, Any, Any, Any]]
    inspect: Callable[..., dict[str, jax.Array]]


def loop(
    of: MemberFunctions,
    act: Callable[..., Any],
    mesh: Mesh,
    traces: population.Traces,
) -> Loop:
    """The loop's functions.

    Args:
      of: functions of one member; its environment is stepped on the host.
      act: `Method.act`.
      mesh: the devices.
      traces: counts the traces of functions that training calls.
    """
    environment, config = of.environment, of.config
    assert isinstance(environment, HostEnvironment)
    functions = _compile(of, mesh, traces)

    def first(members, index, task):
        shaped = len(members.keys), config.envs
        lanes = open_lanes(environment, shaped[0] * shaped[1])
        number = np.zeros(shaped, np.int32)
        seeds = host_episodes.seeds(np.asarray(functions.roots(members, index)), number)
        observation = lanes.reset(int(task.physics), seeds.ravel())
        return host_episodes.begin(
            environment, number, shown(observation, task, shaped)
        )

    def start(members, learner, active, index, task):
        episodes = population.place(first(members, index, task), mesh)
        return functions.begin(members, learner, active, index, episodes)

    def state_shape(members, learner, active, index, task):
        number = np.zeros((len(members.keys), config.envs), np.int32)
        observation = np.zeros((*number.shape, environment.observation_size))
        episodes = host_episodes.begin(
            environment, number, observation.astype(np.float32)
        )
        return jax.eval_shape(
            functions.begin, members, learner, active, index, episodes
        )

    return Loop(
        begin=start,
        chunk=functools.partial(_chunk, environment, functions, config, mesh),
        rollout=functools.partial(play, environment, config.envs, act),
        state_shape=state_shape,
    )


def _compile(of: MemberFunctions, mesh: Mesh, traces: population.Traces) -> _Functions:
    environment, config = of.environment, of.config
    length, size = environment.episode_length, (config.envs, environment.action_size)

    def roots(member, index):
        return jax.random.key_data(of.start_keys(member, index).reset)

    def draws(member, index, time):
        key, sac = of.keys(member, index).steps, member.sac
        sequences = None
        if sac.noise_color:
            # All sequences that these steps can need, each drawn once.
            starts = time + length * jnp.arange((config.update_every - 2) // length + 2)
            sequences = jax.vmap(
                lambda start: exploration.sample_colored(key, start, size, length, sac)
            )(starts)

        def of_step(now):
            sequence = None
            if sequences is not None:
                sequence = sequences[now // length - time // length]
            collect_key = random_keys.of_step(key, now).collect
            return exploration.sample_action_noise(
                collect_key, now, size, config.random_steps, sequence
            )

        return jax.vmap(of_step)(time + jnp.arange(config.update_every))

    def act(members, draws, number, acting, extras, observation, steps):
        def one(member, draws, acting, extras, observation, steps):
            draw = jax.tree.map(lambda leaf: leaf[number], draws)
            method = of.method(member)
            return exploration.explore(draw, acting, extras, observation, steps, method)

        return jax.vmap(one)(members, draws, acting, extras, observation, steps)

    def store_and_update(member, learner, buffer, active, index, time, played):
        def store(number, buffer):
            action, extras, step = jax.tree.map(lambda leaf: leaf[number], played)
            at = time + number
            return train_loop.store(buffer, at, action, extras, step, length)

        buffer = jax.lax.fori_loop(0, config.update_every, store, buffer)
        done = time + config.update_every
        step_keys = random_keys.of_step(of.keys(member, index).steps, done - 1)
        state, metrics = train_loop.update_from_buffer(
            step_keys.update,
            RunnerState(learner, CollectorState(buffer, (), ()), active),
            done,
            config.before(done),
            config.due(done),
            updates=config.updates,
            environment=environment,
            method=of.method(member),
            settings=member.sac,
        )
        return state.learner, buffer, state.active, metrics

    def inspect(member, learner, buffer, index, time):
        state = RunnerState(learner, CollectorState(buffer, (), ()), jnp.asarray(True))
        key, method = of.keys(member, index).steps, of.method(member)
        return train_loop.inspect(key, state, time, length, method, member.sac)

    over = functools.partial(population.over, mesh)

    return _Functions(
        roots=over(roots, 0, None),
        begin=over(of.start, 0, 0, 0, None, 0),
        draws=over(draws, 0, None, None),
        # Called at each step, so not through `shard_map`, which is slower.
        act=jax.jit(traces.of(act)),
        # With overlap, the previous learner acts meanwhile, so it is not donated.
        store_and_update=over(
            store_and_update,
            0,
            0,
            0,
            0,
            None,
            None,
            0,
            donate=(2,) if config.overlap else (1, 2),
            traces=traces,
        ),
        inspect=over(inspect, 0, 0, 0, None, None),
    )


def _chunk(
    environment: HostEnvironment,
    functions: _Functions,
    config: LoopConfig,
    mesh: Mesh,
    members: Members,
    state: RunnerState,
    index: int,
    task: Task,
    time: int,
    steps: int,
) -> tuple[RunnerState, ChunkMetrics]:
    """Collects and updates for a chunk, a multiple of `LoopConfig.update_every`."""
    assert steps % config.update_every == 0
    learner, (buffer, episodes, extras), active, acting = state
    episodes = jax.tree.map(np.asarray, episodes)
    lanes = open_lanes(environment, episodes.steps.size)
    roots = np.asarray(functions.roots(members, index))
    host_episodes.replay_actions(lanes, task, roots, episodes, buffer, time)
    # NumPy arrays, because each step reads them.
    task = jax.tree.map(np.asarray, task)
    cpu = jax.local_devices(backend="cpu")[0]
    here = functools.partial(jax.device_put, device=cpu)
    actors, extras = here(members), here(extras)
    acting = here(acting or (learner.params, learner.method_state))
    learning: Any = None
    made, metrics, updates = [], [], 0
    # JAX runs one thread's calls in order, so actions would wait for updates.
    with ThreadPoolExecutor(1) as other:
        for start in range(time, time + steps, config.update_every):
            played = []
            draws = here(functions.draws(members, index, start))
            for number in range(config.update_every):
                drawn, extras = functions.act(
                    actors,
                    draws,
                    number,
                    acting,
                    extras,
                    episodes.state.observation,
                    episodes.steps,
                )
                action = np.asarray(drawn)
                episodes, step = host_episodes.advance(
                    environment, lanes, task, roots, episodes, action
                )
                played.append((action, jax.tree.map(np.asarray, extras), step))
            along = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *played)
            made.append(along[2])
            updates += int(config.due(start + config.update_every))
            if learning:
                learner, buffer, active, values = learning.result()
                metrics.append(values)
            before = learner
            learning = other.submit(
                functions.store_and_update,
                members,
                learner,
                buffer,
                active,
                index,
                start,
                along,
            )
            newest = before if config.overlap else learning.result()[0]
            acting = here((newest.params, newest.method_state))
        learner, buffer, active, values = learning.result()
        metrics.append(values)
    totals = jax.tree.map(lambda *values: sum(map(np.asarray, values)), *metrics)
    end = time + steps
    report = _report(made, totals, updates)._replace(
        inspected=functions.inspect(members, learner, buffer, index, end)
    )
    episodes, extras = population.place((episodes, extras), mesh)
    return RunnerState(
        learner,
        CollectorState(buffer, episodes, extras),
        active,
        population.place(acting, mesh) if config.overlap else (),
    ), report


def _report(made: list[Step], metrics: Any, updates: int) -> ChunkMetrics:
    """Returns the sums over a chunk's steps, `[members, every, envs]` each."""
    step = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *made)
    ended = step.terminal | step.truncated

    def total(values):
        return np.sum(np.where(ended, values, 0), axis=(1, 2))

    return ChunkMetrics(
        episodes=total(1),
        returns=total(step.score),
        rewards=step.reward.mean(axis=2).sum(axis=1),
        updates=np.full(len(ended), updates),
        metrics=metrics,
        inspected={},
        successes=jax.tree.map(total, step.success),
    )
