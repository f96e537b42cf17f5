"""The loop of a task whose environments are stepped on the host.

It makes the same steps, updates and random draws as `training.train`; only where
environments are stepped differs. What is in the middle of an episode is known by the
episode's seed and the actions since, which lie in the replay buffer: where the
simulators are not where a state says, they are brought there by playing these again.
"""

# NumPy's arrays stand where the records below have JAX's.
# mypy: disable-error-code="arg-type"

import functools
import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from numpy.typing import NDArray

from rewire_jax import population, rollout, training
from rewire_jax.envs.base import HostEnvironment, State, Task
from rewire_jax.errors import UserError
from rewire_jax.lanes import Lanes, open_lanes
from rewire_jax.methods.base import Method
from rewire_jax.population import Members
from rewire_jax.rollout import Episode, Rollout, Step, Success
from rewire_jax.training import Collection, Report, Shape

Array = NDArray[Any]


class Loop(NamedTuple):
    """The functions of a program that step environments; see `program.Program`."""

    begin: Callable[..., training.State]
    chunk: Callable[..., tuple[training.State, Report]]
    rollout: Callable[..., Rollout]
    expect: Callable[..., training.State]
    traces: Callable[[], int]


class _Functions(NamedTuple):
    """What is compiled; the first axis of all is `[members]`.

    Attributes:
      roots: `(members, index) -> [members, 2]` uint32, what episodes are drawn from.
      begin: `(members, learner, alive, index, episodes) -> State`.
      sequence: `(members, index, time) -> ` coloured noise, on the CPU.
      act: `(members, acting, label, observation, steps, index, time, sequence) ->
        actions, label`, on the CPU: it then waits for no other device's updates.
      absorb: `(members, learner, buffer, alive, index, time, played) -> learner,
        buffer, alive, metrics`, stores `Shape.every` steps and makes the updates that
        are due after them; the given buffer is used up.
      inspect: `(members, learner, buffer, index, time) -> metrics`.
    """

    roots: Callable[..., jax.Array]
    begin: Callable[..., training.State]
    sequence: Callable[..., jax.Array]
    act: Callable[..., tuple[jax.Array, Any]]
    absorb: Callable[..., tuple[Any, Any, Any, Any]]
    inspect: Callable[..., dict[str, jax.Array]]


def loop(
    environment: HostEnvironment,
    make: Callable[[Any], Method],
    act: Callable[..., Any],
    task_keys: Callable[[Any, Any], jax.Array],
    begin: Callable[..., training.State],
    shape: Shape,
    mesh: Mesh,
) -> Loop:
    """The loop's functions.

    Args:
      environment: stepped on the host.
      make: `member -> Method`.
      act: `Method.act`.
      task_keys: `(member, index) -> keys`, those of a task's start and steps first.
      begin: `(member, learner, alive, index, episodes) -> State`, a task's start.
      shape: sizes of the loop.
      mesh: the devices.
    """
    functions = _compile(environment, make, task_keys, begin, shape, mesh)
    counted: list[Any] = [functions.act, functions.absorb]

    def first(members, index, task):
        count = len(members.keys) * shape.envs
        lanes = open_lanes(environment, count)
        roots = np.asarray(functions.roots(members, index))
        number = np.zeros((len(members.keys), shape.envs), np.int32)
        observation = lanes.reset(int(task.physics), _seeds(roots, number).ravel())
        return _episodes(environment, number, _seen(observation, task, number.shape))

    def start(members, learner, alive, index, task):
        episodes = population.place(first(members, index, task), mesh)
        return functions.begin(members, learner, alive, index, episodes)

    def expect(members, learner, alive, index, task):
        number = np.zeros((len(members.keys), shape.envs), np.int32)
        observation = np.zeros((*number.shape, environment.observation_size))
        episodes = _episodes(environment, number, observation.astype(np.float32))
        return jax.eval_shape(functions.begin, members, learner, alive, index, episodes)

    return Loop(
        begin=start,
        chunk=functools.partial(_chunk, environment, functions, shape, mesh),
        rollout=functools.partial(_rollout, environment, shape, act),
        expect=expect,
        traces=lambda: sum(function._cache_size() for function in counted),
    )


def _compile(
    environment: HostEnvironment,
    make: Callable[[Any], Method],
    task_keys: Callable[[Any, Any], jax.Array],
    begin: Callable[..., training.State],
    shape: Shape,
    mesh: Mesh,
) -> _Functions:
    length, size = environment.episode_length, (shape.envs, environment.action_size)

    def roots(member, index):
        return jax.random.key_data(jax.random.split(task_keys(member, index)[0], 4)[1])

    def sequence(member, index, time):
        key = task_keys(member, index)[1]
        return training.draw_sequence(key, time, size, length, member.sac)

    def act(member, acting, label, observation, steps, index, time, sequence):
        key = jax.random.fold_in(task_keys(member, index)[1], time)
        return training.explore(
            jax.random.split(key)[0],
            acting,
            label,
            observation,
            steps,
            time,
            make(member),
            shape,
            sequence,
        )

    def absorb(member, learner, buffer, alive, index, time, played):
        def store(number, buffer):
            action, label, step = jax.tree.map(lambda leaf: leaf[number], played)
            at = time + number
            return training.store(buffer, at, action, label, step, length)

        buffer = jax.lax.fori_loop(0, shape.every, store, buffer)
        done = time + shape.every
        key = jax.random.fold_in(task_keys(member, index)[1], done - 1)
        state, metrics = training.follow(
            jax.random.split(key)[1],
            training.State(learner, Collection(buffer, (), ()), alive),
            done,
            environment=environment,
            method=make(member),
            settings=member.sac,
            shape=shape,
        )
        return state.learner, buffer, state.alive, metrics

    def inspect(member, learner, buffer, index, time):
        state = training.State(learner, Collection(buffer, (), ()), jnp.asarray(True))
        key, method = task_keys(member, index)[1], make(member)
        return training.inspect(key, state, time, length, method, member.sac)

    def over(function, *axes, donate=(), mesh=mesh):
        return population.compiled(jax.vmap(function, axes), axes, mesh, donate)

    host = population.host()
    return _Functions(
        roots=over(roots, 0, None),
        begin=over(begin, 0, 0, 0, None, 0),
        sequence=over(sequence, 0, None, None, mesh=host),
        act=over(act, 0, 0, 0, 0, 0, None, None, 0, mesh=host),
        absorb=over(absorb, 0, 0, 0, 0, None, None, 0, donate=(2,)),
        inspect=over(inspect, 0, 0, 0, None, None),
    )


def _chunk(
    environment: HostEnvironment,
    functions: _Functions,
    shape: Shape,
    mesh: Mesh,
    members: Members,
    state: training.State,
    index: int,
    task: Task,
    time: int,
    steps: int,
) -> tuple[training.State, Report]:
    """Collects and learns for some steps, a multiple of `Shape.every`."""
    assert steps % shape.every == 0
    learner, (buffer, episodes, label), alive, acting = state
    episodes = jax.tree.map(np.asarray, episodes)
    lanes = open_lanes(environment, episodes.steps.size)
    roots = np.asarray(functions.roots(members, index))
    _recall(lanes, task, roots, episodes, buffer, time)
    here = functools.partial(population.place, mesh=population.host())
    actors, label = here(members), here(label)
    acting = here(acting or (learner.params, learner.memory))
    colored = bool(members.sac.noise_color)
    sequence: Any = None
    learning: Any = None
    made, metrics, updates = [], [], 0
    # JAX begins what one thread asks for in turn: actions would wait for updates.
    with ThreadPoolExecutor(1) as other:
        for start in range(time, time + steps, shape.every):
            played = []
            for now in range(start, start + shape.every):
                if colored and (sequence is None or now % len(sequence[0]) == 0):
                    sequence = functions.sequence(actors, index, now)
                seen = episodes.state.observation
                drawn, label = functions.act(
                    actors, acting, label, seen, episodes.steps, index, now, sequence
                )
                action = np.asarray(drawn)
                episodes, step = _advance(
                    environment, lanes, task, roots, episodes, action
                )
                played.append((action, jax.tree.map(np.asarray, label), step))
            along = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *played)
            made.append(along[2])
            updates += int(shape.due(start + shape.every))
            if learning:
                learner, buffer, alive, values = learning.result()
                metrics.append(values)
            before = learner
            learning = other.submit(
                functions.absorb, members, learner, buffer, alive, index, start, along
            )
            newest = before if shape.overlap else learning.result()[0]
            acting = here((newest.params, newest.memory))
        learner, buffer, alive, values = learning.result()
        metrics.append(values)
    totals = jax.tree.map(lambda *values: sum(map(np.asarray, values)), *metrics)
    end = time + steps
    report = _report(made, totals, updates)._replace(
        inspected=functions.inspect(members, learner, buffer, index, end)
    )
    episodes, label = population.place((episodes, label), mesh)
    return training.State(
        learner,
        Collection(buffer, episodes, label),
        alive,
        population.place(acting, mesh) if shape.overlap else (),
    ), report


def _report(made: list[Step], metrics: Any, updates: int) -> Report:
    """What a chunk's steps `[members, every, envs]` each sum up to."""
    step = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *made)
    ended = step.terminal | step.truncated

    def total(values):
        return np.sum(np.where(ended, values, 0), axis=(1, 2))

    return Report(
        episodes=total(1),
        returns=total(step.score),
        rewards=step.reward.mean(axis=2).sum(axis=1),
        updates=np.full(len(ended), updates),
        metrics=metrics,
        inspected={},
        successes=jax.tree.map(total, step.success),
    )


def _seeds(roots: Array, number: Array) -> Array:
    """Seeds `[members, envs]` of each environment's so many-th episode."""
    return np.array(
        [
            [
                np.random.SeedSequence([*root, env, of]).generate_state(1)[0]
                for env, of in enumerate(row)
            ]
            for root, row in zip(roots, number, strict=True)
        ],
        np.int64,
    )


def _seen(observation: Array, task: Task, shape: tuple[int, ...]) -> Array:
    """What a policy is shown, `[*shape, observations]`."""
    return observation.reshape(*shape, -1) * np.asarray(task.observation_mask)


def _episodes(environment: HostEnvironment, number: Array, observation: Array) -> Any:
    """Environments `[members, envs]` at the start of an episode.

    An environment's inner state is the number of its episode. Unlike compiled ones it
    keeps no start: the next episode has one of its own.
    """
    shape = number.shape
    false, zero = np.zeros(shape, bool), np.zeros(shape, np.float32)
    known = environment.success
    state = State(number, observation, zero, false, false if known else ())
    success = Success(false, false) if known else ()
    return Episode(state, (), np.zeros(shape, np.int32), zero, success)


def _advance(
    environment: HostEnvironment,
    lanes: Lanes,
    task: Task,
    roots: Array,
    episodes: Any,
    action: Array,
) -> tuple[Any, Step]:
    """Steps all environments; ended episodes are followed by new ones."""
    shape = episodes.steps.shape
    scaled = action * np.asarray(task.action_scale)
    moment = lanes.step(scaled.reshape(-1, action.shape[-1]))
    last = following = _seen(moment.observation, task, shape)
    reward, terminal = moment.reward.reshape(shape), moment.terminal.reshape(shape)
    known = environment.success
    solved = moment.success.reshape(shape) if known else ()
    steps, score = episodes.steps + np.int32(1), episodes.score + reward
    truncated = (steps >= environment.episode_length) & ~terminal
    success = rollout.succeed(episodes.success, solved)
    ended, number = terminal | truncated, episodes.state.inner
    if ended.any():
        number = number + ended.astype(np.int32)
        seeds = _seeds(roots, number).ravel()
        following = _seen(lanes.reset(lanes.task, seeds, ended.ravel()), task, shape)
    return Episode(
        State(number, following, reward, terminal, solved),
        (),
        np.where(ended, np.int32(0), steps),
        np.where(ended, np.float32(0), score),
        jax.tree.map(lambda x: x & ~ended, success),
    ), Step(reward, terminal, truncated, last, following, score, success)


def _recall(
    lanes: Lanes, task: Task, roots: Array, episodes: Any, buffer: Any, time: int
) -> None:
    """Brings the simulators where the episodes are, by playing them again.

    Raises:
      UserError: they come out elsewhere.
    """
    seeds, steps = _seeds(roots, episodes.state.inner).ravel(), episodes.steps.ravel()

    def there() -> bool:
        seen = _seen(lanes.observation, task, episodes.steps.shape)
        return (
            lanes.task == int(task.physics)
            and np.array_equal(lanes.seeds, seeds)
            and np.array_equal(lanes.steps, steps)
            and np.array_equal(seen, episodes.state.observation, equal_nan=True)
        )

    if there():
        return
    longest = int(steps.max())
    lanes.reset(int(task.physics), seeds)
    rows = buffer.action.shape[1]
    # The shorter ones join later, so that all are there at the same time.
    for number in range(longest):
        if number and (joins := steps == longest - number).any():
            lanes.reset(lanes.task, seeds, joins)
        action = np.asarray(buffer.action[:, (time - longest + number) % rows])
        action = action * np.asarray(task.action_scale)
        moment = lanes.step(action.reshape(len(seeds), -1))
        if moment.terminal.any():  # in those that join later
            lanes.reset(lanes.task, seeds, moment.terminal)
    if longest and (joins := steps == 0).any():
        lanes.reset(lanes.task, seeds, joins)
    if not there():
        raise UserError(
            "the simulator does not repeat the episode that the checkpoint lies in: go "
            "on where it was written, with the same versions, or delete the checkpoint "
            "with -step- in its name, to repeat the task"
        )


@functools.lru_cache
def _greedy(act: Callable[..., Any]) -> Callable[..., jax.Array]:
    """`(policies [lanes], observations [lanes]) -> actions`, without exploration."""
    return jax.jit(lambda policy, seen: jnp.tanh(jax.vmap(act)(policy, seen)[0]))


def _rollout(
    environment: HostEnvironment,
    shape: Shape,
    act: Callable[..., Any],
    tasks: Task,
    policies: Any,
    keys: jax.Array,
    count: int,
) -> Rollout:
    """Plays whole episodes, see `rollout.episodes`."""
    members, rows = keys.shape
    lanes = open_lanes(environment, members * shape.envs)
    roots = np.asarray(jax.random.key_data(keys))
    played = (members, rows, count)
    returns, lengths = np.zeros(played, np.float32), np.zeros(played, np.int32)
    solved = [np.zeros(played, bool) for _ in range(2)]
    for row in range(rows):
        task = jax.tree.map(lambda leaf, row=row: leaf[row], tasks)
        places = list(itertools.product(range(members), range(count)))
        while places:
            # The last lanes may play what others play, too.
            turn = list(itertools.islice(itertools.cycle(places), len(lanes.seeds)))
            places = places[len(turn) :]
            who, which = np.array(turn).T
            at = who, np.full(len(turn), row), which
            seeds = [
                np.random.SeedSequence([*roots[m, row], e]).generate_state(1)[0]
                for m, e in turn
            ]
            policy = jax.tree.map(lambda leaf, w=who, r=row: leaf[w, r], policies)
            result = _play(environment, lanes, act, task, policy, seeds)
            for kept, values in zip((returns, lengths, *solved), result, strict=True):
                kept[at] = values
    success = Success(*solved) if environment.success else ()
    return Rollout(returns, lengths, success)


def _play(
    environment: HostEnvironment,
    lanes: Lanes,
    act: Callable[..., Any],
    task: Task,
    policy: Any,
    seeds: list[Any],
) -> tuple[Array, Array, Array, Array]:
    """An episode in each lane: return, length, success at any and at the last step."""
    size = len(seeds)
    observation = lanes.reset(int(task.physics), seeds)
    alive, any_, last = np.ones(size, bool), np.zeros(size, bool), np.zeros(size, bool)
    returns, lengths = np.zeros(size, np.float32), np.zeros(size, np.int32)
    for _ in range(environment.episode_length):
        action = np.asarray(_greedy(act)(policy, _seen(observation, task, (size,))))
        moment = lanes.step(action * np.asarray(task.action_scale))
        returns, lengths = returns + np.where(alive, moment.reward, 0), lengths + alive
        any_, last = (
            any_ | (alive & moment.success),
            np.where(alive, moment.success, last),
        )
        alive = alive & ~moment.terminal
        if not alive.any():
            break
        observation = moment.observation
        if moment.terminal.any():
            # What ended must be begun anew; nothing there counts any more.
            observation = lanes.reset(lanes.task, seeds, moment.terminal)
    return returns, lengths, any_, last
