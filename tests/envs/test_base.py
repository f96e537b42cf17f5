import jax
import jax.numpy as jnp
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.envs.base import State, TaskChange, check_state
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


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None, "heavy"])
@pytest.mark.parametrize(
    "change",
    [
        lambda x: {"gravity": x},
        lambda x: {"friction": x},
        lambda x: {"hidden": x},
        lambda x: {"bodies": {"torso": x}},
        lambda x: {"actions": {"*": x}},
    ],
)
def test_a_change_is_of_finite_numbers(change, value) -> None:
    with pytest.raises(UserError, match="odd"):
        TaskChange("odd", **change(value))
