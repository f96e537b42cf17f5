"""Measures what only a machine with a GPU can tell, in steps that can be resumed.

Each step runs in a process of its own and writes `STEP.json`. A finished step is
skipped. One that fails leaves `STEP.error.txt`, and the others go on. So you can
repeat the command until nothing is left.
"""

import contextlib
import functools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import tyro

import rewire_jax
from experiments import suite
from experiments.speed import permutation
from experiments.speed.environments import compiled_loops
from experiments.speed.kernels import kernels, profile
from experiments.speed.loops import whole_loop
from experiments.speed.part import Effort, on_probe
from experiments.speed.timing import Loop, in_turn, repetitions
from experiments.speed.updates import METHODS, update_loop, updates
from experiments.suite import Row
from rewire_jax.core.arguments import require
from rewire_jax.core.formatting import seconds as seconds_of
from rewire_jax.envs.base import Environment
from rewire_jax.storage import run_folder
from rewire_jax.training.run_setup import prepare

LONGEST = 540  # seconds of a step
_SAVING = 60  # seconds that training may need to end its chunk and to save
TESTS = {
    "nn": "nn/test_*.py",
    "envs": "envs/test_*.py",
    "methods-a-p": "methods/test_[a-p]*.py",
    "methods-q-z": "methods/test_[q-z]*.py",
    "training-a-h": "training/test_[a-h]*.py",
    "training-i-z": "training/test_[i-z]*.py",
    "run": "run/test_*.py",
}
MEMBERS = (1, 2, 8, 32, 128)
BACKENDS = ("v1", "positional", "spring", "mjx")
ENVIRONMENTS = (128, 1024, 8192)
TRAINED = ("rewire", "ft1", "sac_n")


@dataclass(frozen=True, kw_only=True)
class Accelerator:
    """What to measure.

    Attributes:
      only: steps to make, in this order; all if none is named.
      limit: time to stop after, for example 9m. A step that needs more is not begun.
      list: print the steps, about how long each takes, and which are finished.
      tiny: a dry run of minutes, also on a CPU: sizes are tiny.
      out: folder of the results; by default `runs/accelerator`, or
        `runs/accelerator-tiny`.
      work: folder for the training runs, with their checkpoints.
      measure: make this step in this process.
    """

    only: tuple[str, ...] = ()
    limit: Annotated[str | None, tyro.conf.arg(name="for")] = None
    list: tyro.conf.FlagCreatePairsOff[bool] = False
    tiny: tyro.conf.FlagCreatePairsOff[bool] = False
    out: Path | None = None
    work: Path = Path("runs")
    measure: str | None = None

    @property
    def folder(self) -> Path:
        """The folder of the results."""
        name = "accelerator-tiny" if self.tiny else "accelerator"
        return self.out or Path("runs") / name

    @property
    def effort(self) -> Effort:
        """How much is measured."""
        return Effort(2, 0.02, quick=True) if self.tiny else Effort(5, 0.5)

    @property
    def seconds(self) -> float:
        """Time for a step, or for all."""
        return float("inf") if self.limit is None else seconds_of(self.limit)

    def settings(self, method: str, **sac: Any) -> rewire_jax.Settings:
        """The paper's settings of a method, except in a dry run."""
        return self.effort.settings(method, **{} if self.tiny else sac)

    def state(self, step: str) -> str:
        """How far a step is, in a word."""
        if self.error(step).exists():
            return "failed"
        path = self.folder / f"{step}.json"
        result = json.loads(path.read_text()) if path.exists() else {}
        return {None: "", False: "begun", True: "finished"}[result.get("finished")]

    def error(self, step: str) -> Path:
        """The file that a failed step leaves."""
        return self.folder / f"{step}.error.txt"


class Step(NamedTuple):
    """A step.

    Attributes:
      seconds: about what it takes on a fast GPU; it is not begun with less time left.
      measure: returns what it writes; `finished` is False if there is more to do.
    """

    seconds: int
    measure: Callable[[Accelerator], dict[str, Any]]


def tests(pattern: str, job: Accelerator) -> dict[str, Any]:
    """Runs tests; the rows are those that did not pass."""
    pattern = "nn/test_dormancy.py" if job.tiny else pattern
    files = sorted(map(str, Path("tests").glob(pattern)))
    # Processes share the device. Tests compare with sums in full precision.
    shared = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    shared |= {"JAX_DEFAULT_MATMUL_PRECISION": "float32"}
    workers = min(4, (os.cpu_count() or 1) // 2)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "tests.xml"
        command = [sys.executable, "-m", "pytest", *files, "-m", "not slow"]
        command += [f"--junitxml={path}", "-n", f"{workers}", "--dist", "loadfile"]
        code = subprocess.run(command, env=os.environ | shared, check=False).returncode
        require(code in (0, 1), f"pytest {' '.join(files)} ended with {code}")
        cases = list(ElementTree.parse(path).iter("testcase"))
    rows = []
    for case in cases:
        for found in (*case.iter("failure"), *case.iter("error")):
            test = f"{case.get('classname')}::{case.get('name')}"
            rows.append({"test": test, "message": found.get("message", "")[:500]})
    skipped = sum(case.find("skipped") is not None for case in cases)
    return {"rows": rows, "tests": len(cases), "skipped": skipped}


def update_rates(policy: str, width: int, job: Accelerator) -> dict[str, Any]:
    """Updates a second of populations, which share their batches."""
    settings = job.settings(METHODS[policy], hidden=width)
    loops: dict[int, Loop] = {}
    for members in (1, 2) if job.tiny else MEMBERS:
        print(f"preparing {members} members", flush=True)
        loops[members] = update_loop(replace(settings, seeds=members))
    timings = in_turn(loops, job.effort.rounds, job.effort.seconds)
    rows: list[Row] = []
    for members, timing in timings.items():
        row = {"policy": policy, "hidden": settings.sac.hidden, "members": members}
        row["updates_per_second"] = members * timing.best
        row["gain"] = members * timing.over(timings[1])
        rows.append(row | timing.figures())
    return {"rows": rows}


def environment_rates(backend: str, job: Accelerator) -> dict[str, Any]:
    """Environment steps a second, with random actions."""
    backend = "probe" if job.tiny else backend
    scenario = rewire_jax.make_scenario(job.effort.scenario, backend)
    environment, task = scenario.environment, scenario.tasks[0].data
    assert isinstance(environment, Environment)
    counts = (2, 4) if job.tiny else ENVIRONMENTS
    loops = dict(compiled_loops(environment, task, counts))
    timings = in_turn(loops, job.effort.rounds, job.effort.seconds)
    rows: list[Row] = []
    for count, timing in timings.items():
        row = {"backend": backend, "count": count}
        row["steps_per_second"] = count * timing.best
        rows.append(row | timing.figures())
    return {"rows": rows}


def count_kernels(policy: str, job: Accelerator) -> dict[str, Any]:
    """Kernels, loops and branches: of updates alone, and of a chunk on a probe."""
    settings = job.settings(METHODS[policy])
    state, advance, batches = updates(settings)
    programs = {"updates": jax.jit(advance).lower(state, batches, 64).compile()}
    plan = prepare(on_probe(settings))
    program, members = plan.program, plan.stacked
    task = jax.tree.map(lambda leaf: leaf[0], plan.tasks)
    began = jax.eval_shape(program.init, members), jnp.ones(1, bool), 0, task
    shapes = program.state_shape(members, *began)
    lowered = program.chunk.lower(members, shapes, 0, task, 0, 1)  # type: ignore
    programs["chunk"] = lowered.compile()
    rows = [
        {"policy": policy, "program": name} | row
        for name, compiled in programs.items()
        for row in kernels(compiled)
    ]
    return {"rows": rows}


def waiting(job: Accelerator) -> dict[str, Any]:
    """Share of the time in which a GPU has nothing to do, in training on a probe."""
    rows: list[Row] = []
    for policy, method in METHODS.items():
        for members in (1,) if job.tiny else (1, 32):
            settings = on_probe(replace(job.settings(method), seeds=members))
            loop = whole_loop(settings)
            count = repetitions(loop, job.effort.seconds)
            row = {"policy": policy, "members": members, "steps": count}
            rows.append(row | profile(functools.partial(loop, count)))
    return {"rows": rows}


def blocks(job: Accelerator) -> dict[str, Any]:
    """Times of the permutation's gradient in its scores, by its blocks."""
    return {"rows": permutation.block_times(job.effort)}


def train(method: str, job: Accelerator) -> dict[str, Any]:
    """Trains a population on the first task until the time is over, or to the end."""
    settings = replace(job.settings(method), tasks=1, seeds=10)
    if job.tiny:
        settings = replace(settings, seeds=2, eval_episodes=2, selection_episodes=2)
    folder = job.work / f"{job.folder.name}-train-{method}"
    scenario = rewire_jax.make_scenario(settings.scenario, settings.backend)
    run = suite.Run(folder, scenario, settings)
    stop = functools.partial(os.kill, os.getpid(), signal.SIGINT)
    timer = threading.Timer(min(job.seconds, LONGEST) - _SAVING, stop)
    timer.start()
    try:
        if not run.finished:
            rewire_jax.train(settings, folder, resume=run.started)
    except rewire_jax.Stopped as stopped:
        print(stopped, flush=True)
    finally:
        timer.cancel()
    # Without its checkpoints, a run can still be read and reported on.
    copy = job.folder / f"train-{method}"
    copy.mkdir(exist_ok=True)
    for name in (run_folder.HEADER, *run_folder.TABLES):
        shutil.copy(folder / name, copy)
    lines = (copy / "timing.jsonl").read_text().splitlines()
    return {"rows": [*map(json.loads, lines)], "finished": run.finished}


@functools.cache
def steps() -> dict[str, Step]:
    """All steps, in their order."""
    part = functools.partial
    return {
        **{f"tests-{k}": Step(420, part(tests, files)) for k, files in TESTS.items()},
        **{
            f"updates-{policy}-{width}": Step(240, part(update_rates, policy, width))
            for width in (256, 1024)
            for policy in METHODS
        },
        **{
            f"environments-{name}": Step(240, part(environment_rates, name))
            for name in BACKENDS
        },
        **{f"kernels-{name}": Step(120, part(count_kernels, name)) for name in METHODS},
        "waiting": Step(180, waiting),
        "blocks": Step(180, blocks),
        **{f"train-{name}": Step(240, part(train, name)) for name in TRAINED},
    }


def apart(job: Accelerator, step: str, seconds: float) -> None:
    """Makes a step in a process of its own; a failed one leaves a file."""
    module = [sys.executable, "-m", "experiments.accelerator", "--measure", step]
    command = [*module, "--out", f"{job.folder}", "--work", f"{job.work}"]
    command += ["--for", f"{int(seconds)}s"]
    command += ["--tiny"] if job.tiny else []
    log = job.folder / f"{step}.log"
    job.error(step).unlink(missing_ok=True)
    why = f"not finished after {seconds:.0f} s"
    with log.open("w") as said:
        process = subprocess.Popen(
            command, stdout=said, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = process.wait(seconds)
                why = f"ended with {code}" if code else ""
        finally:
            # Also what it has started itself.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        said.write(f"{why}\n")
    if why:
        log.replace(job.error(step))
    else:
        log.unlink()


def measure(job: Accelerator, step: str) -> None:
    """Makes a step in this process, and writes its result."""
    began = time.perf_counter()
    made = {"step": step, "tiny": job.tiny, "finished": True}
    made |= steps()[step].measure(job)
    made["seconds"] = time.perf_counter() - began
    made["provenance"] = run_folder.provenance()
    run_folder.write(job.folder / f"{step}.json", made)


def run(job: Accelerator) -> None:
    """Makes all steps for which there is time; or lists them; or makes a single one.

    Raises:
      UserError: wrong arguments, or steps failed.
    """
    known, named = steps(), [job.measure] if job.measure else []
    chosen = job.only or tuple(known)
    for step in (*chosen, *named):
        require(step in known, f"no step {step!r}: choose from {', '.join(known)}")
    end = time.monotonic() + job.seconds
    if job.measure:
        measure(job, job.measure)
        return
    if not job.list:
        run_folder.make(job.folder)
    for step in chosen:
        needs, left = known[step].seconds, end - time.monotonic()
        if job.list:
            print(f"{step:<24}{needs:>5} s  {job.state(step)}")
        elif job.state(step) == "finished":
            print(f"{step}: finished before", flush=True)
        elif needs > left:
            print(f"{step}: needs {needs} s, {left:.0f} s are left", flush=True)
        else:
            print(f"{step}: begun", flush=True)
            apart(job, step, min(left, LONGEST))
            print(f"{step}: {job.state(step)}", flush=True)
    failed = [step for step in chosen if job.state(step) == "failed"]
    require(
        job.list or not failed,
        f"failed: {', '.join(failed)}; {job.folder}/STEP.error.txt says why",
    )


if __name__ == "__main__":
    suite.command(Accelerator, run, "accelerator")
