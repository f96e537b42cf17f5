"""The steps of a run for one member: pure functions, to be vmapped and compiled."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rewire_jax.envs.base import Environment, HostEnvironment, Task
from rewire_jax.methods import segments
from rewire_jax.methods.base import Candidates, Method, Selection, Tools
from rewire_jax.methods.shared import axes
from rewire_jax.methods.spec import Spec
from rewire_jax.training import random_keys, replay_buffer, rollout, sac, train_loop
from rewire_jax.training.loop_state import (
    ChunkMetrics,
    CollectorState,
    LoopConfig,
    RunnerState,
)
from rewire_jax.training.population import Members
from rewire_jax.training.random_keys import StartKeys, Stream, TaskKeys
from rewire_jax.training.sac import TrainState


@dataclass(frozen=True)
class MemberFunctions:
    """Functions of one member; their attributes are static.

    `member` is an entry of `Members`; `index` is the `[]` int of a task in the
    sequence, or of a segment; `time` is the number of vector steps made in it.

    Attributes:
      environment: environment of the scenario.
      make: the method's constructor.
      spec: sizes of the networks and of the sequence.
      config: sizes of the training loop.
    """

    environment: Environment | HostEnvironment
    make: Callable[[Spec, Any], Method]
    spec: Spec
    config: LoopConfig

    def method(self, member: Members) -> Method:
        """Returns the member's method."""
        return segments.build(self.make, self.spec, member.options)

    def keys(self, member: Members, index: jax.Array) -> TaskKeys:
        """Returns the member's keys for a task."""
        return random_keys.of_task(member.keys, index)

    def start_keys(self, member: Members, index: jax.Array) -> StartKeys:
        """Returns the member's keys for the start of a task."""
        return random_keys.named(StartKeys, self.keys(member, index).start)

    def init(self, member: Members) -> TrainState:
        """Returns the learner before the first task."""
        key = jax.random.fold_in(member.keys, 0)
        return sac.init(key, self.method(member), self.spec, member.sac)

    def begin(
        self,
        member: Members,
        learner: TrainState,
        active: jax.Array,
        index: jax.Array,
        task: Task,
    ) -> RunnerState:
        """Starts a task with compiled environments."""
        keys = jax.random.split(self.start_keys(member, index).reset, self.config.envs)
        environment = self.environment
        assert isinstance(environment, Environment)
        episodes = jax.vmap(lambda key: rollout.begin(environment, task, key))(keys)
        return self.start(member, learner, active, index, episodes)

    def start(
        self,
        member: Members,
        learner: TrainState,
        active: jax.Array,
        index: jax.Array,
        episodes: rollout.Episode,
    ) -> RunnerState:
        """Starts a task with environments `[envs]`, just reset or already running."""
        method, keys = self.method(member), self.start_keys(member, index)
        params, method_state = method.start_task(
            keys.method, learner.params, learner.method_state, index
        )
        learner = learner.with_learned((params, method_state))
        if method.fresh_critic:
            critic = sac.init_critic(keys.critic, self.spec, method.critic_extra)
            learner = sac.start_critic(learner, critic, member.sac)
        extras = method.extras(keys.extras, method_state, None, episodes.steps)
        buffer = replay_buffer.create(
            episodes.state.observation,
            transitions=self.config.transitions,
            actions=self.spec.actions,
            episode_length=self.environment.episode_length,
            extras=extras,
        )
        learner = sac.restart(learner, member.sac)
        acting = (params, method_state) if self.config.overlap else ()
        collection = CollectorState(buffer, episodes, extras)
        return RunnerState(learner, collection, active, acting)

    def change_task(
        self,
        member: Members,
        state: RunnerState,
        number: jax.Array,
        time: jax.Array,
        task: Task,
    ) -> RunnerState:
        """Changes the task of the environments, of which the learner is not told.

        Episodes that are to begin are reset for the new task; others go on in it.

        Args:
          member: the member.
          state: the member's state.
          number: `[]` int, how many tasks there were before.
          time: `[]` int, vector steps stored in the buffer.
          task: the new task.
        """
        environment = self.environment
        assert isinstance(environment, Environment)
        keys = random_keys.of_rollout(
            member.keys, Stream.CHANGE, number, self.config.envs
        )
        fresh = jax.vmap(lambda key: rollout.begin(environment, task, key))(keys)
        buffer, running, extras = state.collection
        running = running._replace(start=fresh.start)
        begins = running.steps == 0
        episodes = jax.vmap(train_loop.select)(begins, fresh, running)
        buffer = replay_buffer.restart(buffer, time, episodes.state.observation)
        return state._replace(collection=CollectorState(buffer, episodes, extras))

    def after_baseline(
        self, member: Members, state: RunnerState, before: jax.Array
    ) -> RunnerState:
        """Tells the method its candidates' returns at a task's start."""
        method, learner = self.method(member), state.learner
        assert method.after_baseline is not None
        learned = method.after_baseline(learner.params, learner.method_state, before)
        return state._replace(
            learner=learner.with_learned(learned),
            acting=learned if self.config.overlap else (),
        )

    def chunk(
        self,
        member: Members,
        state: RunnerState,
        index: jax.Array,
        task: Task,
        time: jax.Array,
        steps: jax.Array,
    ) -> tuple[RunnerState, ChunkMetrics]:
        """Collects and updates for a chunk, with compiled environments."""
        assert isinstance(self.environment, Environment)
        return train_loop.run_chunk(
            self.keys(member, index).steps,
            state,
            task,
            time,
            steps,
            environment=self.environment,
            method=self.method(member),
            settings=member.sac,
            config=self.config,
        )

    def consolidate(
        self, member: Members, state: RunnerState, index: jax.Array, time: jax.Array
    ) -> TrainState:
        """Calls the method's `consolidate`, then resets what a task resets."""
        method = self.method(member)
        assert method.consolidate is not None
        learner, buffer = state.learner, state.collection.buffer

        def sample(key, count):
            length = self.environment.episode_length
            return replay_buffer.sample(buffer, key, time, count, length)

        def q(context, observation, action):
            inputs = method.critic_input(context, observation)
            return sac.q_values(learner.critic, inputs, action, member.sac.network)

        learned = method.consolidate(
            self.keys(member, index).consolidate,
            learner.params,
            learner.method_state,
            index,
            Tools(sample, q),
        )
        return sac.restart(learner.with_learned(learned), member.sac)

    def offline_update(
        self,
        member: Members,
        state: RunnerState,
        index: jax.Array,
        time: jax.Array,
        done: jax.Array,
        steps: jax.Array,
    ) -> RunnerState:
        """Makes `steps` rounds of offline updates; `done` rounds were made before."""
        method = self.method(member)
        update = functools.partial(
            train_loop.update_from_buffer,
            due=True,
            updates=self.config.updates,
            environment=self.environment,
            method=method,
            settings=method.offline_sac(member.sac),
        )
        key = self.keys(member, index).offline

        def step(number, state):
            before = number * self.config.updates
            step_key = jax.random.fold_in(key, number)
            return update(step_key, state, time, before)[0]

        return jax.lax.fori_loop(done, done + steps, step, state)

    def candidates(
        self, member: Members, learner: TrainState, index: jax.Array
    ) -> Candidates:
        """Returns the policies among which the method chooses."""
        method = self.method(member)
        assert method.candidates is not None
        return method.candidates(learner.params, learner.method_state, index)

    def finish(
        self,
        member: Members,
        learner: TrainState,
        index: jax.Array,
        selection: Selection | None,
    ) -> TrainState:
        """Ends a task, with the returns of the candidates."""
        learned = self.method(member).end_task(
            learner.params, learner.method_state, index, selection
        )
        return learner.with_learned(learned)

    def policies(self, member: Members, learner: TrainState) -> Any:
        """Returns the policies of all tasks, `[tasks]` except `Shared` parts."""
        of_task = self.method(member).policy
        policy = functools.partial(of_task, learner.params, learner.method_state)
        tasks = jnp.arange(self.spec.tasks)
        out_axes = axes(jax.eval_shape(policy, tasks[0]))
        return jax.vmap(policy, out_axes=out_axes)(tasks)

    def size(self, member: Members, learner: TrainState) -> tuple[jax.Array, jax.Array]:
        """Returns `[]` each: numbers that the method stores, and of stored states."""
        method, learned = self.method(member), (learner.params, learner.method_state)
        return method.size(*learned), method.stored(*learned)
