import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.envs import batched_switch

INDICES = jnp.asarray([1, 0, 1])
VALUES = jnp.arange(24.0).reshape(3, 2, 4)  # indices, members, environments


@pytest.fixture
def calls():
    """The sizes of the batches that each of two functions ran on, and their choice."""
    seen = []

    def function(number, name):
        def run(batch, offset):
            jax.debug.callback(lambda: seen.append((name, len(batch))), ordered=True)
            return {"out": batch * number + offset}

        return run

    return seen, batched_switch.switch(
        [function(2.0, "double"), function(3.0, "triple")]
    )


def test_a_shared_index_runs_its_function_once_on_the_whole_batch(calls):
    seen, choose = calls
    inner = jax.vmap(choose, (None, 0, None))
    program = jax.jit(jax.vmap(inner, (None, 0, 0)))
    out = program(jnp.asarray(1), VALUES[0], jnp.asarray([10.0, 20.0]))
    jax.effects_barrier()
    np.testing.assert_array_equal(
        out["out"], 3 * np.asarray(VALUES[0]) + [[10.0], [20.0]]
    )
    assert seen == [("triple", 8)]


def test_indices_take_turns_and_members_share_each(calls):
    seen, choose = calls
    # As episodes are evaluated: members around tasks around environments.
    environments = jax.vmap(choose, (None, 0, None))
    tasks = jax.vmap(environments, (0, 0, None))
    program = jax.jit(jax.vmap(tasks, (None, 1, None)))
    out = program(INDICES, VALUES, jnp.asarray(1.0))
    jax.effects_barrier()
    factors = np.asarray([3.0, 2.0, 3.0])[None, :, None]
    expected = np.asarray(VALUES).swapaxes(0, 1) * factors + 1
    np.testing.assert_array_equal(out["out"], expected)
    assert seen == [("triple", 8), ("double", 8), ("triple", 8)]


def test_one_element_alone(calls):
    seen, choose = calls
    out = jax.jit(choose)(jnp.asarray(0), jnp.asarray(5.0), jnp.asarray(1.0))
    jax.effects_barrier()
    assert out["out"] == 11
    assert seen == [("double", 1)]
