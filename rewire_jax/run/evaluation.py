"""Facts about scenarios, and evaluations of runs."""

from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from rewire_jax.core.settings import require
from rewire_jax.envs.scenarios import Scenario
from rewire_jax.methods import METHODS, find_method
from rewire_jax.methods.base import Selection, Spec
from rewire_jax.run import run_state
from rewire_jax.run.run_state import saved
from rewire_jax.storage import run_folder
from rewire_jax.training import memory_estimate, rollout
from rewire_jax.training.presets import preset
from rewire_jax.training.run_setup import base_size, make_spec, prepare

_MOST_EPISODES = 2**20
_others = jax.jit(jax.vmap(jax.vmap(jax.random.fold_in, (0, None)), (0, None)))


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
    run: str | Path, *, stage: int | None = None, episodes: int = 128, seed: int = 0
) -> list[dict[str, Any]]:
    """Evaluates a run on all its tasks, without exploration.

    Args:
      run: folder of the run.
      stage: evaluate the policies from after this task's training; the latest if None.
      episodes: number for each task and member; played in parts if the memory does
        not hold all of them.
      seed: seed of the episodes.

    Returns:
      A row for each member and task: task, name, seed (the member's), return, std (over
      episodes), steps (of all episodes), diverged (whether the member is no longer
      updated). If the environment defines success, also success and success_last: the
      share of episodes solved at any step, and at the last.

    Raises:
      UserError: no such run or stage, or a damaged checkpoint.
    """
    require(
        1 <= episodes <= _MOST_EPISODES,
        f"--episodes must be 1 to {_MOST_EPISODES}, not {episodes}",
    )
    folder = Path(run)
    require(
        run_folder.kind(folder) == "run",
        f"{folder} holds a sweep: `rewire-jax report {folder}` shows its evaluations, "
        "load_policy gives the policy of a member",
    )
    _, settings = saved(folder)
    plan = prepare(settings)
    learner = jax.eval_shape(plan.program.init, plan.stacked)
    like = learner.params, learner.method_state
    owner = run_state.identity(plan.settings, plan.members)
    (params, method_state), active = run_state.read_policies(folder, stage, like, owner)
    learner = plan.program.init(plan.stacked)._replace(
        params=params, method_state=method_state
    )
    policies = plan.program.policies(plan.stacked, learner)
    keys = jax.random.split(jax.random.key(seed), (plan.num_slots, len(plan.names)))
    at_once = memory_estimate.episodes_at_once(plan, policies, episodes)
    parts = []
    for part in range(-(-episodes // at_once)):
        rolled = plan.program.rollout(plan.tasks, policies, keys, at_once)
        parts.append(jax.tree.map(np.asarray, rolled))
        keys = _others(keys, part)
    result = jax.tree.map(lambda *x: np.concatenate(x, axis=2)[..., :episodes], *parts)
    returns, lengths = result.returns, result.lengths
    solved = rollout.named(result.success)
    return [
        {
            "task": task,
            "name": name,
            "seed": member.seed,
            "return": float(returns[place, task].mean()),
            "std": float(returns[place, task].std()),
            "steps": int(lengths[place, task].sum()),
            "diverged": not active[place],
        }
        | {name: float(x[place, task].mean()) for name, x in solved.items()}
        for place, member in enumerate(plan.members)
        for task, name in enumerate(plan.names)
    ]
