"""Facts about scenarios, and evaluations of runs."""

import itertools
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.arguments import check_optional, check_whole, require
from rewire_jax.core.settings import MOST_EPISODES
from rewire_jax.envs.scenarios import Scenario
from rewire_jax.methods import METHODS, find_method
from rewire_jax.methods.base import Selection
from rewire_jax.methods.spec import Spec
from rewire_jax.run import episode_parts, run_checkpoints, task_choice, task_header
from rewire_jax.run.run_checkpoints import saved
from rewire_jax.run.task_choice import Choice, Trials
from rewire_jax.storage import run_folder
from rewire_jax.training import rollout
from rewire_jax.training.presets import preset
from rewire_jax.training.run_setup import Plan, base_size, make_spec, prepare

TaskLabel = Literal["given", "none"]


def info(scenario: Scenario) -> dict[str, Any]:
    """Facts about a scenario, JSON-ready.

    The model size of a method is the largest that it can reach in this scenario with
    the paper profile, divided by the size of a plain policy. Stored states are counted
    in the same way, apart from it.
    """
    sizes, stored = {}, {}
    for method in METHODS:
        settings = preset(scenario, method)
        spec = make_spec(settings, scenario.environment)
        options, base = settings.options.checked(), base_size(spec)
        sizes[method] = max(most_stored(method, spec, options)) / base
        stored[method] = max(most_stored(method, spec, options, "stored")) / base
    return {
        "scenario": scenario.name,
        "domain": scenario.domain,
        "backend": scenario.backend,
        "interactions": scenario.interactions,
        "observation_size": scenario.environment.observation_size,
        "action_size": scenario.environment.action_size,
        "tasks": [
            {
                "name": task.name,
                "action_scale": task.action_scale.tolist(),
                "observation_mask": task.observation_mask.tolist(),
            }
            for task in scenario.tasks
        ],
        "model_size": sizes,
        "stored_states": {name: size for name, size in stored.items() if size},
    }


def most_stored(
    name: str, spec: Spec, options: Any, part: Literal["size", "stored"] = "size"
) -> list[int]:
    """The largest count of numbers that a method stores in a run over all tasks.

    Args:
      name: name of the method.
      spec: sizes of the networks and of the sequence.
      options: the method's settings.
      part: the method's function that counts.

    Returns:
      Two counts, because the count may depend on which candidate wins: for a run in
      which the method's first candidate always wins, and for one in which its last
      does.
    """
    method = find_method(name).make(spec, options)

    def run(best_first: jax.Array) -> jax.Array:
        key = jax.random.key(0)

        def one(carry: Any, task: jax.Array) -> tuple[Any, jax.Array]:
            params, method_state = method.start_task(key, carry[0], carry[1], task)
            selection = None
            if method.candidates is not None:
                valid = method.candidates(params, method_state, task).valid
                after = 1.0 + jnp.arange(valid.size)
                after = jnp.where(best_first, after[::-1], after)
                selection = Selection(jnp.zeros_like(after), after)
            carry = method.end_task(params, method_state, task, selection)
            return carry, getattr(method, part)(*carry)

        _, sizes = jax.lax.scan(one, method.init(key), jnp.arange(spec.tasks))
        return jnp.max(sizes)

    # The compiler removes everything that the count does not need.
    numbers = jax.jit(jax.vmap(run))(jnp.array([True, False]))
    return [int(number) for number in numbers]


def evaluate(
    run: str | Path,
    *,
    stage: int | None = None,
    episodes: int = 128,
    seed: int = 0,
    task_label: TaskLabel = "given",
    trials: int = 2,
    trial_steps: int | None = None,
) -> list[dict[str, Any]]:
    """Evaluates a run on all its tasks, without exploration.

    With task labels, each task is played by its own policy. Without, the policies of
    all tasks trained so far are candidates. One of them is chosen by its return in
    trials, see `halving.choose`, and plays the same episodes.

    Args:
      run: folder of the run.
      stage: evaluate the policies from after this task's training; the latest if None.
      episodes: number for each task and member; played in parts if the memory does
        not hold all of them.
      seed: seed of the episodes.
      task_label: "given", or "none" to evaluate also without task labels.
      trials: without labels, how often each remaining candidate plays in a round.
      trial_steps: length of a trial, from a reset; a whole episode if None.

    Returns:
      A row for each member and task: task, name, seed (the member's), return, std (over
      episodes), steps (of all episodes), diverged (whether the member is no longer
      updated). If the environment defines success, also success and success_last: the
      share of episodes solved at any step, and at the last. Without labels, also
      chosen, a dictionary with return, std, steps and success of the chosen policy; its
      task and name (the first of them, if the policies of several tasks are equal);
      recognised (whether it is the policy of this task, at any place in the sequence;
      None if the task was not trained yet); candidates (the number of different
      policies) and interactions (steps of all trials).

    Raises:
      UserError: no such run or stage, a damaged checkpoint, or an argument out of
        range.
    """
    check_optional("--stage", stage)
    check_whole("--episodes", episodes, 1, MOST_EPISODES)
    check_whole("--seed", seed)
    require(
        task_label in get_args(TaskLabel),
        f"--task-label must be given or none, not {task_label}",
    )
    folder = Path(run)
    require(
        run_folder.kind(folder) == "run",
        f"{folder} holds a sweep: `rewire-jax report {folder}` shows its evaluations, "
        "load_policy gives the policy of a member",
    )
    header, settings = saved(folder)
    plan = prepare(settings)
    task_header.check_tasks(folder, header, plan.scenario, len(plan.names))
    stage = run_checkpoints.latest(folder) if stage is None else stage
    policies, active = _policies(folder, stage, plan)
    choice = None
    if task_label == "none":
        how = Trials(trials, trial_steps, seed)
        choice = task_choice.choose(plan, policies, stage + 1, how)
    keys = jax.random.split(jax.random.key(seed), (plan.num_slots, len(plan.names)))
    result = episode_parts.play(plan, plan.tasks, policies, keys, episodes)
    rows = [
        {"task": task, "name": name, "seed": member.seed}
        | _measured(result, place, task)
        | {"diverged": not active[place]}
        for place, member in enumerate(plan.members)
        for task, name in enumerate(plan.names)
    ]
    if choice is None:
        return rows
    policies = task_choice.pick(plan, policies, choice.place)
    result = episode_parts.play(plan, plan.tasks, policies, keys, episodes)
    places = itertools.product(range(len(plan.members)), range(len(plan.names)))
    return [
        row | {"chosen": _chosen(choice, plan, at) | _measured(result, *at)}
        for row, at in zip(rows, places, strict=True)
    ]


def _policies(folder: Path, stage: int, plan: Plan) -> tuple[Any, np.ndarray]:
    """Policies `[members, tasks]` after a stage; and which members did not diverge."""
    learner = jax.eval_shape(plan.program.init, plan.stacked)
    like = learner.params, learner.method_state
    owner = run_checkpoints.identity(plan.settings, plan.members)
    learned, active = run_checkpoints.read_policies(folder, stage, like, owner)
    learner = plan.program.init(plan.stacked).with_learned(learned)
    return plan.program.policies(plan.stacked, learner), active


def _measured(result: rollout.Rollout, place: int, task: int) -> dict[str, Any]:
    """Means over the episodes of a member in a task."""
    returns = result.returns[place, task]
    solved = rollout.named(result.success)
    return {
        "return": float(returns.mean()),
        "std": float(returns.std()),
        "steps": int(result.lengths[place, task].sum()),
    } | {name: float(x[place, task].mean()) for name, x in solved.items()}


def _chosen(choice: Choice, plan: Plan, at: tuple[int, int]) -> dict[str, Any]:
    """What was chosen by a member in a task."""
    task = int(choice.place[at])
    return {
        "task": task,
        "name": plan.names[task],
        "recognised": bool(choice.recognised[at]) if choice.trained[at] else None,
        "candidates": int(choice.candidates[at]),
        "interactions": int(choice.interactions[at]),
    }
