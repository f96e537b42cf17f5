"""Do later tasks change old policies? Compares their actions after each later task.

For each task of a campaign's runs: the policy plays one episode of the task right after
its own training, and the visited states are kept. In these states, the policy of the
task after each later task acts again.
"""

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import rewire_jax
from experiments import suite
from rewire_jax.core.arguments import require
from rewire_jax.core.errors import UserError
from rewire_jax.envs.base import Environment, HostEnvironment
from rewire_jax.reports import plots
from rewire_jax.reports.campaign_data import read_campaign_data
from rewire_jax.run.policies import Policies
from rewire_jax.training.acting import Act

NOTES = (
    "Right after the training of a task, its policy visits some states. The table "
    "shows how its actions in these states change later: their squared change, "
    "divided by their variance. 0: the policy acts as before. 2: it acts like an "
    "unrelated policy whose actions have the same mean and variance. A cell is the "
    "median (lowest to highest) over tasks and seeds.",
)


@dataclass(frozen=True, kw_only=True)
class Kept:
    """What to compare.

    Attributes:
      file: TOML file of a campaign on compiled environments.
      runs: folder of the campaign; by default runs/ and the name of the file.
      out: the result files, without a suffix; by default in experiments/results.
    """

    file: Path
    runs: Path | None = None
    out: Path | None = None


def visited(
    environment: Environment, act: Act, learned: Any, task: jax.Array, data: Any
) -> jax.Array:
    """Observations `[steps, observations]` of one episode; after its end, the last."""

    def step(state, _):
        after = environment.step(data, state, act(learned, task, state.observation))
        after = jax.tree.map(
            lambda old, new: jnp.where(state.terminal, old, new), state, after
        )
        return after, state.observation

    start = environment.reset(data, jax.random.key(0))
    return jax.lax.scan(step, start, length=environment.episode_length)[1]


def change(before: jax.Array, after: jax.Array) -> jax.Array:
    """`[]`, of actions `[steps, actions]`, see `NOTES`."""
    return jnp.mean((after - before) ** 2) / jnp.mean(jnp.var(before, axis=0))


def measure(
    folders: Sequence[Path], scenario: rewire_jax.Scenario, tasks: int
) -> list[dict[str, Any]]:
    """A row for each task, each later task and each seed.

    Args:
      folders: finished runs that differ only in their seeds.
      scenario: of all of them.
      tasks: number of their tasks.

    Raises:
      UserError: the host steps the environment.
    """
    environment = scenario.environment
    if isinstance(environment, HostEnvironment):
        raise UserError(f"{folders[0]}: use runs on compiled environments")
    runs = [
        [rewire_jax.load_policies(folder, stage=stage) for stage in range(tasks)]
        for folder in folders
    ]
    # Compiled once: the runs act alike.
    act = runs[0][0].act
    play = jax.jit(partial(visited, environment, act))
    changes = partial(_changes, scenario, jax.jit(act), play)
    return [row for stages in runs for row in changes(stages)]


def _changes(
    scenario: rewire_jax.Scenario,
    act: Act,
    play: Callable[..., jax.Array],
    stages: Sequence[Policies],
) -> list[dict[str, Any]]:
    """The rows of one run; `stages` are its policies after each task."""
    rows = []
    for seed in stages[0].seeds:
        learned = [policies.member(seed) for policies in stages]
        for task in range(len(stages) - 1):
            states = play(learned[task], task, scenario.tasks[task].data)
            before, *later = (act(member, task, states) for member in learned[task:])
            rows += [
                {
                    "seed": seed,
                    "task": scenario.tasks[task].name,
                    "later": number,
                    "change": float(change(before, actions)),
                }
                for number, actions in enumerate(later, 1)
            ]
    return rows


def table(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """For people: a line for each configuration."""
    numbers = sorted({row["later"] for row in rows})
    lines = [["method", *(f"{n} later" for n in numbers), "seeds"]]
    for (label,), own in suite.grouped(rows, "method").items():
        later = suite.grouped(own, "later")
        cells = [_text([row["change"] for row in later[n,]]) for n in numbers]
        lines.append([label, *cells, str(len({row["seed"] for row in own}))])
    return lines


def _text(values: Sequence[float]) -> str:
    """Median and lowest to highest; the values may lie decades apart."""
    low, high = min(values), max(values)
    return f"{statistics.median(values):.2g} ({low:.2g} to {high:.2g})"


def draw(rows: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Writes the picture: change against the number of later tasks."""
    figure, (axes,) = plots.empty((7.0, 4.2), 1, 1)
    for i, ((label,), own) in enumerate(suite.grouped(rows, "method").items()):
        later = suite.grouped(own, "later")
        numbers = [number for (number,) in later]
        values = [[row["change"] for row in each] for each in later.values()]
        style = plots.look(i)
        axes.plot(numbers, [statistics.median(v) for v in values], **style, label=label)
        for n, each in zip(numbers, values, strict=True):
            axes.scatter([n] * len(each), each, color=style["color"], s=12)
    axes.set_xticks(sorted({row["later"] for row in rows}))
    axes.set_xlabel("later tasks")
    axes.set_ylabel("change of actions")
    axes.set_yscale("log")
    axes.grid(axis="y", color="0.9")
    figure.legend(loc="outside right center", frameon=False)
    plots.entitle(
        figure, title, "lines: median; points: a task of a seed; 0 is not shown"
    )
    figure.savefig(path)


def run(job: Kept) -> None:
    """Measures all finished runs and writes the result.

    Raises:
      UserError: the campaign cannot be read, or no run with several tasks is finished.
    """
    data = read_campaign_data(job.file, job.runs)
    folders: dict[tuple[str, str, str, int], list[Path]] = {}
    for one in data.jobs:
        made = one.run.settings
        if one.done and made.tasks > 1:
            key = one.run.configuration, made.scenario, made.backend, made.tasks
            folders.setdefault(key, []).append(one.folder)
    rows = []
    for (label, name, backend, tasks), those in folders.items():
        scenario = rewire_jax.make_scenario(name, backend)
        rows += [{"method": label} | row for row in measure(those, scenario, tasks)]
    require(bool(rows), f"no run of {job.file} with several tasks is finished")
    title = f"Change of old policies' actions. {data.campaign.title}"
    out = job.out or suite.RESULTS / f"cached-actions-{job.file.stem}"
    picture = f"![Change of actions]({out.name}.png)"
    suite.write(out, title, table(rows), [*NOTES, "", picture], rows)
    draw(rows, title, out.with_suffix(".png"))


if __name__ == "__main__":
    suite.command(Kept, run, "cached_actions")
