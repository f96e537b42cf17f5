import jax
import jax.numpy as jnp
import pytest

from rewire_jax.envs.base import State, check_state
from rewire_jax.envs.probe import make_domain

ENVIRONMENT = make_domain("reach").environment
SIZE = ENVIRONMENT.observation_size
RIGHT = State((), jnp.zeros(SIZE), jnp.zeros(()), jnp.zeros((), bool))


@pytest.mark.parametrize(
    "wrong",
    [
        {"observation": jnp.zeros(SIZE + 1)},
        {"observation": jnp.zeros(SIZE, int)},
        {"reward": jnp.zeros(1)},
        {"terminal": jnp.zeros((1,), bool)},
        {"terminal": jnp.zeros(())},
    ],
)
def test_states_of_other_shapes_and_types_are_refused(wrong):
    assert check_state(ENVIRONMENT, RIGHT) is RIGHT
    with pytest.raises(AssertionError):
        jax.eval_shape(
            lambda state: check_state(ENVIRONMENT, state), RIGHT._replace(**wrong)
        )


def test_success_is_looked_at_where_it_is_known():
    knowing = ENVIRONMENT._replace(success=True)
    check_state(knowing, RIGHT._replace(success=jnp.zeros((), bool)))
    with pytest.raises(AssertionError):
        check_state(knowing, RIGHT._replace(success=jnp.zeros(2, bool)))
