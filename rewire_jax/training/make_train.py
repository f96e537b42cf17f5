"""Training as one pure function, from a key to arrays.

`train` in `rewire_jax.run` computes the same in chunks, so that it can print and save
results between them. A chunk is the steps between two progress reports. Both call the
functions in `MemberFunctions`.
"""

import dataclasses
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.arguments import require
from rewire_jax.core.settings import SacSettings, Settings
from rewire_jax.envs.base import Environment, Task
from rewire_jax.envs.scenarios import Scenario
from rewire_jax.methods import find_method
from rewire_jax.methods.base import Method, Selection
from rewire_jax.training import random_keys, rollout, selection
from rewire_jax.training.acting import Act, Learned, act_function
from rewire_jax.training.given_values import with_values
from rewire_jax.training.loop_state import ChunkMetrics
from rewire_jax.training.member_functions import MemberFunctions
from rewire_jax.training.population import Members
from rewire_jax.training.random_keys import Stream
from rewire_jax.training.run_setup import (
    Budget,
    chunk_steps,
    complete,
    make_budget,
    make_functions,
)
from rewire_jax.training.sac import TrainState


class Curves(NamedTuple):
    """Learning curves.

    A report covers `Settings.report_every` interactions, rounded down to whole rounds
    of updates, but at least one round. The last report of a task may be shorter.

    Attributes:
      interactions: `[tasks, reports]` int, training interactions in the task so far.
      returns: `[tasks, reports]`, mean return of the training episodes that ended;
        NaN if no episode ended.
      rewards: `[tasks, reports]`, mean reward of a step.
      metrics: `[tasks, reports]` by name. Metrics of updates are means over the rounds
        of updates, each round represented by its last update. Metrics of
        `Method.inspect` are those at the end of the report.
    """

    interactions: jax.Array
    returns: jax.Array
    rewards: jax.Array
    metrics: dict[str, jax.Array]


class Trained(NamedTuple):
    """The results of training.

    Attributes:
      returns: `[tasks + 1, tasks]`, mean returns without exploration. The columns are
        the evaluated tasks. The first row is from before the first task; each other
        row is from after a task.
      success: `Success` of the same shape, shares of the evaluation episodes; `()` if
        the environment does not define success.
      curves: learning curves.
      learned: parameters and state after the last task, for `make_act`.
      active: `[]` bool, False if a parameter became NaN or infinite. The learner was
        not updated after that.
      selection: `[]` int, interactions spent on choosing between policies.
    """

    returns: jax.Array
    success: Any
    curves: Curves
    learned: Learned
    active: jax.Array
    selection: jax.Array


class Train(Protocol):
    """Learns a sequence of tasks: a pure function, which you can jit and vmap."""

    def __call__(
        self, key: jax.Array, sac: SacSettings | None = None, options: Any = None
    ) -> Trained:
        """Trains with the random key `key`.

        Args:
          key: determines all randomness.
          sac: SAC's settings. They may differ from the settings given to `make_train`
            in their traced values only; `jax.vmap` over them is a sweep. None for the
            given ones.
          options: the method's settings, in the same way.

        Raises:
          UserError: settings of another class, or an invalid value; values that JAX
            traces are not checked.
          ValueError: `key` is not one of `jax.random.key`.
        """
        ...


def make_train(settings: Settings, scenario: Scenario | None = None) -> Train:
    """Returns training as a pure function of a random key.

    The function writes no files and prints nothing. The key `jax.random.key(seed)`
    gives the results of a run with this seed, up to rounding.

    Args:
      settings: settings of the run, for instance from `preset`. Its `seed`, `seeds`
        and `checkpoint_every` are ignored: pass a key for each seed.
      scenario: your own scenario; if None, the settings name it.

    Raises:
      UserError: a setting is invalid, or the host steps the scenario's environments.
    """
    settings, scenario = complete(settings, scenario)
    environment = scenario.environment
    require(
        isinstance(environment, Environment),
        f"{scenario.name} on {scenario.backend} is stepped on the host and cannot be "
        "compiled: use train, which writes a folder",
    )
    require(
        settings.boundaries == "given",
        "--boundaries detected: the host decides when a task begins; use train, which "
        "writes a folder",
    )
    functions = make_functions(settings, scenario)
    sequence = [task.data for task in scenario.tasks[: settings.tasks]]
    tasks = jax.tree.map(lambda *leaves: jnp.stack(leaves), *sequence)
    budget = make_budget(settings, functions)

    def train(
        key: jax.Array, sac: SacSettings | None = None, options: Any = None
    ) -> Trained:
        given = with_values(settings, sac, options)
        numbers = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), given)
        kind = getattr(key, "dtype", np.dtype(object))
        if not jnp.issubdtype(kind, jax.dtypes.prng_key):  # else it is taken for two
            raise ValueError("the key must be one of jax.random.key")
        member = Members(key, *numbers)
        return _Training(settings, functions, budget, tasks, member).run()

    return train


def make_act(settings: Settings, scenario: Scenario | None = None) -> Act:
    """Returns a function that acts with what `make_train` has learned.

    Args:
      settings: the settings that `make_train` was given.
      scenario: the scenario that `make_train` was given.

    Returns:
      `(Trained.learned, task, observation) -> action`, without exploration.

    Raises:
      UserError: a setting is invalid.
    """
    settings, scenario = complete(settings, scenario)
    spec = make_functions(settings, scenario).spec
    method = find_method(settings.method).build(spec, settings.options)
    return act_function(method, spec)


@dataclasses.dataclass(frozen=True)
class _Training:
    """The training of one member; its fields stay constant."""

    settings: Settings
    functions: MemberFunctions
    budget: Budget
    tasks: Task
    member: Members

    @property
    def environment(self) -> Environment:
        assert isinstance(self.functions.environment, Environment)
        return self.functions.environment

    @property
    def method(self) -> Method:
        return self.functions.method(self.member)

    def run(self) -> Trained:
        """Learns the sequence of tasks."""
        start = (
            self.functions.init(self.member),
            jnp.asarray(True),
            jnp.zeros((), jnp.int32),
        )
        # Stage -1 only evaluates. As a stage of the scan, it is compiled together with
        # the other evaluations.
        stages = jnp.arange(-1, self.settings.tasks)
        end, (returns, success, curves) = jax.lax.scan(self.stage, start, stages)
        learner, active, spent = end
        curves = jax.tree.map(lambda leaf: leaf[1:], curves)
        learned = Learned(learner.params, learner.method_state)
        return Trained(returns, success, curves, learned, active, spent)

    def stage(self, carry: Any, index: jax.Array) -> tuple[Any, Any]:
        """Learns a task (none if the index is -1), then evaluates all tasks."""
        learn = jax.jit(self.task)  # traced only once for both uses

        def skip(carry, index):
            curves = jax.eval_shape(learn, carry, index)[1]
            return carry, jax.tree.map(jnp.zeros_like, curves)

        carry, curves = jax.lax.cond(index < 0, skip, learn, carry, index)
        return carry, (*self.evaluate(carry[0], index), curves)

    def task(self, carry: Any, index: jax.Array) -> tuple[Any, Curves]:
        """Learns a task."""
        learner, active, spent = carry
        functions, member = self.functions, self.member
        task = jax.tree.map(lambda leaf: leaf[index], self.tasks)
        state = functions.begin(member, learner, active, index, task)
        before = None
        if self.method.baseline:
            before, spent = self.select(state.learner, index, task, 0, spent)
        if self.method.after_baseline and before is not None:
            state = functions.after_baseline(member, state, before)
        steps = self.budget.steps
        every = chunk_steps(self.settings)

        def chunk(state, done):
            due = jnp.minimum(every, steps - done)
            state, report = functions.chunk(member, state, index, task, done, due)
            return state, (self.report(report, due), done + due)

        state, (reports, done) = jax.lax.scan(chunk, state, jnp.arange(0, steps, every))
        curves = Curves(done * self.settings.envs, *reports)
        if self.method.consolidate:
            learner = functions.consolidate(member, state, index, jnp.asarray(steps))
            state = state._replace(learner=learner)
        if self.budget.offline_steps:
            times = map(jnp.asarray, (steps, 0, self.budget.offline_steps))
            state = functions.offline_update(member, state, index, *times)
        learner, active = state.learner, state.active
        after, spent = self.select(learner, index, task, 1, spent)
        chosen_by = None if after is None else Selection(before, after)
        learner = functions.finish(member, learner, index, chosen_by)
        return (learner, active, spent), curves

    @staticmethod
    def report(
        report: ChunkMetrics, steps: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        """Turns a chunk's sums over `steps` vector steps into the means of `Curves`."""
        updates = jnp.maximum(report.updates, 1.0)
        means = {name: total / updates for name, total in report.metrics.items()}
        returns = jnp.where(report.episodes, report.returns / report.episodes, jnp.nan)
        return returns, report.rewards / steps, means | report.inspected

    def select(
        self,
        learner: TrainState,
        index: jax.Array,
        task: Task,
        phase: int,
        spent: jax.Array,
    ) -> tuple[jax.Array | None, jax.Array]:
        """Evaluates the candidates, as `rewire_jax.run.train_run.Run.select` does."""
        rows = self.budget.rows
        if not rows:
            return None, spent
        candidates = self.functions.candidates(self.member, learner, index)

        def played():
            result = self.play(
                self.method.candidate_score,
                jax.tree.map(lambda leaf: jnp.stack([leaf] * rows), task),
                selection.fill(candidates.policies, rows),
                (Stream.SELECTION, 2 * index + phase),
                self.settings.selection_episodes,
            )
            return selection.judge(result, candidates.valid, spent)

        def skipped():
            return jnp.zeros(len(candidates.valid)), spent

        return jax.lax.cond(candidates.valid.any(), played, skipped)

    def evaluate(
        self, learner: TrainState, index: jax.Array | int
    ) -> tuple[jax.Array, Any]:
        """Returns mean returns and success rates, `[tasks]` each, after a task."""
        result = self.play(
            "episode",
            self.tasks,
            self.functions.policies(self.member, learner),
            (Stream.EVALUATION, index + 1),
            self.settings.eval_episodes,
        )
        success = jax.tree.map(lambda x: x.mean(axis=1), result.success)
        return result.returns.mean(axis=1), success

    def play(
        self,
        score: str,
        tasks: Task,
        policies: Any,
        place: tuple[Stream, jax.Array | int],
        count: int,
    ) -> rollout.Rollout:
        """Plays `[rows, count]` episodes; tasks and policies are `[rows]`."""
        rows = len(jax.tree.leaves(tasks)[0])
        keys = random_keys.of_rollout(self.member.keys, *place, rows)
        policies, keys = jax.tree.map(lambda leaf: leaf[None], (policies, keys))
        play, act = rollout.PLAYS[score], self.method.act
        result = play(self.environment, act, tasks, policies, keys, count)
        return jax.tree.map(lambda leaf: leaf[0], result)
