"""What a chunk of training is compiled to, read from XLA's own text."""

import dataclasses
import re
from collections import Counter
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import pytest

import rewire_jax
from rewire_jax.core.machine_memory import machine_bytes
from rewire_jax.run.progress import Progress
from rewire_jax.run.train_run import Run
from rewire_jax.storage.run_results import read_run
from rewire_jax.training import sac_updates
from rewire_jax.training.memory_estimate import size
from rewire_jax.training.run_setup import prepare
from tests.tiny import tiny

HOST = {"infeed", "outfeed", "send", "recv", "custom-call"}
_NAME = r"%?([\w.\-]+)"
_OPERATION = re.compile(rf"\s+(?:ROOT )?{_NAME} = (\(.*?\)|\S+) ([\w\-]+)\((.*)")
_CALLED = re.compile(rf"(?:body|condition|to_apply|calls|\w+_computation)={_NAME}")
_BRANCHES = re.compile(r"branch_computations=\{([^}]*)\}")


class Operation:
    """A line of a compiled program: its kind, its result's type, what it calls."""

    def __init__(self, match: re.Match[str]):
        _, self.type, self.kind, rest = match.groups()
        branches = _BRANCHES.search(rest)
        self.branches = re.findall(_NAME, branches[1]) if branches else []
        self.calls = _CALLED.findall(rest) + self.branches


class Compiled:
    """A compiled program as computations of operations."""

    def __init__(self, function: jax.stages.Compiled):
        self.text = function.as_text()
        self.computations: dict[str, list[Operation]] = {}
        for block in re.split(r"\n\n", self.text):
            head = re.search(rf"^(?:ENTRY )?{_NAME} .*\{{$", block, re.MULTILINE)
            if head:
                found = map(_OPERATION.match, block[head.end() :].splitlines())
                self.computations[head[1]] = [Operation(m) for m in found if m]

    def inside(self, name: str) -> Iterator[Operation]:
        """The operations of a computation and of all that it calls."""
        for operation in self.computations[name]:
            yield operation
            for called in operation.calls:
                yield from self.inside(called)

    def all(self) -> list[Operation]:
        return [o for operations in self.computations.values() for o in operations]

    def loops_with(self, kind: str) -> list[str]:
        """Bodies of loops in which a kind of operation lies, not deeper."""
        bodies = {o.calls[k] for o in self.all() if o.kind == "while" for k in (0, 1)}
        return [
            name
            for name in sorted(bodies)
            if any(o.kind == kind for o in self.computations[name])
        ]


@pytest.fixture(scope="module")
def plan():
    # As long a buffer as outweighs all that a chunk needs for a while.
    settings = dataclasses.replace(tiny(), interactions=64_000)
    return prepare(settings)


@pytest.fixture(scope="module")
def state(plan):
    task = jax.tree.map(lambda leaf: leaf[0], plan.tasks)
    learner = jax.eval_shape(plan.program.init, plan.stacked)
    active = jax.ShapeDtypeStruct((plan.num_slots,), bool)
    return plan.program.state_shape(plan.stacked, learner, active, 0, task)


@pytest.fixture(scope="module")
def lowered(plan, state):
    task = jax.tree.map(lambda leaf: leaf[0], plan.tasks)
    with pytest.MonkeyPatch.context() as forced:
        # On a GPU, too, with branches.
        forced.setattr(sac_updates, "group_size", lambda *_: 1)
        return plan.program.chunk.lower(plan.stacked, state, 0, task, 0, 10)


@pytest.fixture(scope="module")
def executable(lowered):
    return lowered.compile()


@pytest.fixture(scope="module")
def chunk(executable) -> Compiled:
    return Compiled(executable)


@pytest.fixture(scope="module")
def updates(chunk) -> str:
    """The loop over updates: the only one with branches for the delayed ones."""
    (name,) = chunk.loops_with("conditional")
    return name


def test_reader_finds_what_it_looks_for():
    def talkative(x):
        return jax.lax.fori_loop(0, 5, lambda i, x: tell(x * i), x)

    def tell(x):
        jax.debug.callback(lambda x: None, x)
        return x

    def needs_copy(x):
        return jax.lax.fori_loop(0, 5, lambda i, x: x.at[i].add(jnp.sum(x)), x)

    x = jnp.zeros(99)
    told = Compiled(jax.jit(talkative).lower(x).compile())
    copied = Compiled(jax.jit(needs_copy).lower(x).compile())
    assert HOST & {o.kind for o in told.all()}
    # What is not donated must be left as it was.
    assert any(o.kind == "copy" and "f32[99]" in o.type for o in copied.all())


def test_nothing_goes_to_the_host(chunk):
    kinds = Counter(operation.kind for operation in chunk.all())
    assert kinds["while"] > 2
    assert not HOST & set(kinds)


def test_buffer_is_updated_in_place(chunk, executable, state):
    buffer = state.collection.buffer
    shapes = {",".join(map(str, x.shape)) for x in jax.tree.leaves(buffer)}
    made = [o for o in chunk.all() if any(f"[{s}]" in o.type for s in shapes)]
    assert any(o.kind == "dynamic-update-slice" for o in made)
    for operation in made:
        assert operation.kind not in ("copy", "copy-start", "select", "concatenate")
    planned = executable.memory_analysis()
    assert planned.temp_size_in_bytes < size(buffer) / 4
    # The result lies where the argument lay, all of it.
    assert planned.alias_size_in_bytes >= size(state)


def test_delayed_updates_are_branches(chunk, updates):
    branches = [o for o in chunk.computations[updates] if o.kind == "conditional"]
    products = [
        sorted(
            sum(o.kind == "dot" for o in chunk.inside(name)) for name in branch.branches
        )
        for branch in branches
    ]
    # The policy's has matrix products in one branch alone, the targets' has none.
    (targets, policy) = sorted(products, key=max)
    assert targets == [0, 0]
    assert policy[0] == 0 < policy[1]


def test_updates_draw_no_random_bits(chunk, updates):
    def mixing(operations):
        return sum(o.kind == "xor" and "u32" in o.type for o in operations)

    assert mixing(chunk.inside(updates)) == 0
    # They are drawn before: the loop around has them.
    assert mixing(chunk.all()) > 0


def test_only_the_first_task_is_compiled_and_buffers_go_early(tmp_path, monkeypatch):
    compiled = 0
    after, held = [], {0: [], 1: []}
    # Of a buffer's observations and of its actions.
    shape = (2, 41, 16, 2)
    select = Run.select

    def looking(self, now, learner, task, phase):
        held[phase].append([x.shape for x in jax.live_arrays()].count(shape))
        return select(self, now, learner, task, phase)

    monkeypatch.setattr(Run, "select", looking)

    def listen(event, *_, **__):
        nonlocal compiled
        compiled += event == "/jax/core/compile/backend_compile_duration"

    class Counting(Progress):
        def finish_task(self, *arguments):
            after.append(compiled)
            super().finish_task(*arguments)

    settings = dataclasses.replace(tiny("probe/reach"), tasks=3)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        rewire_jax.train(settings, tmp_path / "run", progress=Counting)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert after[0] == after[1] == after[2]
    # There when candidates are rolled out at a task's start, gone at its end.
    assert held == {0: [2, 2, 2], 1: [0, 0, 0]}
    # Nine functions of a run, and what a few numbers before and after them take.
    assert 6 < after[0] < 25
    # On a CPU there is no memory but the process's.
    (most,) = read_run(tmp_path / "run").memory.values()
    assert 5e7 < most < machine_bytes()
