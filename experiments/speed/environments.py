"""Environment steps a second, by simulator and by how many are side by side."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
from matplotlib.axes import Axes

from experiments.host_loop import simulate
from experiments.speed.part import Effort, Part
from experiments.speed.timing import Loop, in_turn
from experiments.suite import Row, show
from rewire_jax.envs.base import Environment, HostEnvironment, Task
from rewire_jax.envs.domains import BRAX_BACKENDS
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.envs.vector_env import VectorEnv
from rewire_jax.reports import plots

BRAX = "halfcheetah/forgetting"
COUNTS: tuple[int, ...] = (1, 64, 256)
COUNTS_ON_GPU = (*COUNTS, 2048)
META_WORLD = "continual_world/t3"
LANES = (1, 2)
Case = tuple[str, str, int]
"""Environment, backend, and how many."""


def stepping(environment: Environment) -> Callable[..., Any]:
    """`(states, count, task, key) -> states`, so many random steps of all."""

    def play(states, count, task, key):
        size = len(states.reward), environment.action_size

        def step(number, states):
            of_step = jax.random.fold_in(key, number)
            actions = jax.random.uniform(of_step, size, minval=-1.0)
            one = functools.partial(environment.step, task)
            return jax.vmap(one)(states, actions)

        return jax.lax.fori_loop(0, count, step, states)

    return jax.jit(play)


def compiled_loops(
    environment: Environment, task: Task, counts: tuple[int, ...]
) -> Iterator[tuple[int, Loop]]:
    """Loops of an environment that is compiled, each going on from its last state."""
    keys = jax.random.split(jax.random.key(0), max(counts))
    reset = jax.jit(jax.vmap(environment.reset, (None, 0)))
    first, play = reset(task, keys), stepping(environment)
    for count in counts:
        states = [jax.tree.map(lambda leaf, n=count: leaf[:n], first)]

        def loop(steps, states=states):
            states[0] = play(states[0], steps, task, keys[0])
            return states[0].reward

        yield count, loop


def measure(effort: Effort) -> list[Row]:
    """A row for each environment, backend and number."""
    loops: dict[Case, Loop] = {}
    name, counts = BRAX, COUNTS
    backends: tuple[str, ...] = BRAX_BACKENDS
    if jax.default_backend() == "gpu":
        counts = COUNTS_ON_GPU
    if effort.quick:
        name, backends, counts = effort.scenario, ("probe",), (1, 4)
    for backend in backends:
        scenario = make_scenario(name, backend)
        environment, task = scenario.environment, scenario.tasks[0].data
        assert isinstance(environment, Environment)
        print(f"  preparing {backend}", flush=True)
        for count, loop in compiled_loops(environment, task, counts):
            loops[scenario.domain, backend, count] = loop
    if not effort.quick:
        host = make_scenario(META_WORLD).environment
        assert isinstance(host, HostEnvironment)
        for count in LANES:
            loop = functools.partial(simulate, VectorEnv(host, count), host)
            loops["Meta-World, window-close", "MuJoCo", count] = loop
    timings = in_turn(loops, min(effort.rounds, 5), effort.seconds)
    rows = []
    for (name, backend, count), timing in timings.items():
        gain = count * timing.over(timings[name, backend, 1])
        row = {"environment": name, "backend": backend, "count": count, "gain": gain}
        rows.append(row | {"steps_per_second": count * timing.best} | timing.figures())
    return rows


def draw(axes: Axes, rows: list[Row]) -> None:
    """Steps a second by how many are side by side."""
    groups = dict.fromkeys((row["environment"], row["backend"]) for row in rows)
    for i, group in enumerate(groups):
        own = [row for row in rows if (row["environment"], row["backend"]) == group]
        axes.plot(
            [row["count"] for row in own],
            [row["steps_per_second"] for row in own],
            marker="o",
            label=" ".join(group),
            **plots.look(i),
        )
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xlabel("environments side by side")
    axes.set_ylabel("steps a second, all together")
    axes.legend(frameon=False)


PART = Part(
    title="Environment steps a second",
    reading="Random actions, no policy. Brax's environments are compiled. "
    "Meta-World's are simulators on the host; if there are two, each has its own "
    "process. The gain is in steps a second over a single environment, the median of "
    "the ratios in each round.",
    measure=measure,
    columns={
        "environment": show("environment"),
        "backend": show("backend"),
        "side by side": show("count"),
        "steps a second, all together": show("steps_per_second", ",.0f"),
        "gain": show("gain", ",.1f"),
    },
    picture=("Environment steps a second", draw),
)
