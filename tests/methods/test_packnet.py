import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import SacSettings
from rewire_jax.methods import packnet
from rewire_jax.methods.packnet import FREE, PackNetSettings
from rewire_jax.methods.spec import Spec

SPEC = Spec(observations=3, actions=2, hidden=5, depth=2, tasks=4)
KEY = jax.random.key(0)
OBSERVATION = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
SHAPES = [(5, 3), (5,), (5, 5), (5,), (4, 5), (4,)]


@functools.partial(jax.jit, static_argnums=0)
def call(name, options, *arguments):
    return getattr(packnet.packnet(SPEC, options), name)(*arguments)


def make(**values):
    """The method, its numbers traced as in a run."""
    options = PackNetSettings(**values).checked()
    method = packnet.packnet(SPEC, options)
    names = ("init", "consolidate", "adjust_updates", "end_task", "policy")
    return method._replace(
        **{name: functools.partial(call, name, options) for name in names}
    )


def arrays(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def same(one, other):
    for a, b in zip(arrays(one), arrays(other), strict=True):
        np.testing.assert_array_equal(a, b)


def moved(method, params, state, rng):
    """The parameters after a random update, as the training makes it."""
    updates = jax.tree.map(
        lambda x: rng.normal(size=x.shape).astype(np.float32), params
    )
    return jax.tree.map(jnp.add, params, method.adjust_updates(updates, state))


def played(layers, observation=OBSERVATION):
    """An MLP policy in numpy; `layers` are weights and biases by turns."""
    x = observation.astype(np.float64)
    for number in range(0, len(layers), 2):
        x = np.where(x > 0, x, 0.2 * x) if number else x
        x = x @ layers[number].T.astype(np.float64) + layers[number + 1]
    return x[:, :2], np.clip(x[:, 2:], -20, 2)


def after_tasks(method, number, seed=0):
    """Parameters and state before and after each part of some tasks."""
    rng = np.random.default_rng(seed)
    params, state = method.init(KEY)
    stages = {}
    for task in range(number):
        stages[task, "start"] = params, state
        params = moved(method, params, state, rng)
        stages[task, "trained"] = params, state
        params, state = method.consolidate(KEY, params, state, task, None)
        stages[task, "pruned"] = params, state
        params = moved(method, params, state, rng)
        stages[task, "finetuned"] = params, state
        params, state = method.end_task(params, state, task, None)
        stages[task, "end"] = params, state
    return stages


@pytest.fixture(scope="module")
def method():
    return make(keep=0.3)


@pytest.fixture(scope="module")
def stages(method):
    return after_tasks(method, SPEC.tasks)


@pytest.mark.parametrize("keep", [0.125, 0.3, 1.0])
def test_a_task_keeps_its_share_of_every_layer(keep):
    stages = after_tasks(make(keep=keep), 4)
    for leaf, shape in enumerate(SHAPES):
        size = int(np.prod(shape))
        share = -int(-keep * size // 1)
        free = size
        for task in range(4):
            owner = arrays(stages[task, "end"][1].owners)[leaf]
            before = arrays(stages[task, "trained"][1].owners)[leaf]
            assert owner.shape == shape
            assert np.sum(owner == task) == min(share, free)
            free -= min(share, free)
            assert np.sum(owner == FREE) == free
            # What has an owner keeps it.
            np.testing.assert_array_equal(owner[before != FREE], before[before != FREE])


def test_the_largest_of_the_free_are_kept(stages):
    for task in range(SPEC.tasks):
        trained, before = stages[task, "trained"]
        pruned, after = stages[task, "pruned"]
        rows = zip(
            arrays(trained),
            arrays(before.owners),
            arrays(pruned),
            arrays(after.owners),
            strict=True,
        )
        for x, had, y, has in rows:
            free = np.flatnonzero(had == FREE)
            order = sorted(free, key=lambda i, x=x: -abs(x.ravel()[i]))
            kept = order[: int(np.ceil(0.3 * x.size))]
            np.testing.assert_array_equal(
                np.flatnonzero(has == task), np.sort(np.asarray(kept, int))
            )
            # Nothing but what is still free changes, and that to 0.
            np.testing.assert_array_equal(y, np.where(has == FREE, 0, x))


def test_of_equal_magnitudes_the_first_are_kept():
    x = jnp.asarray([[2.0, -2.0, 1.0], [2.0, 0.0, -2.0]])
    free = jnp.asarray([[True, True, True], [False, True, True]])
    kept = packnet.largest(x, free, 1 / 3)
    np.testing.assert_array_equal(kept, [[True, True, False], [False, False, False]])
    zeros = packnet.largest(jnp.zeros(4), jnp.asarray([False, True, True, True]), 0.5)
    np.testing.assert_array_equal(zeros, [False, True, True, False])


def test_updates_change_what_is_trained_and_nothing_else(method, stages):
    def trained(task, stage):
        params, state = stages[task, stage]
        ones = jax.tree.map(jnp.ones_like, params)
        return arrays(method.adjust_updates(ones, state)), arrays(state.owners)

    for task in range(SPEC.tasks):
        for updates, owners in zip(*trained(task, "start"), strict=True):
            np.testing.assert_array_equal(updates, owners == FREE)
        for updates, owners in zip(*trained(task, "pruned"), strict=True):
            np.testing.assert_array_equal(updates, owners == task)
        assert sum(x.sum() for x in trained(task, "start")[0]) > 0
        assert sum(x.sum() for x in trained(task, "pruned")[0]) > 0


def test_updates_stay_zero_even_if_not_finite(method, stages):
    params, state = stages[1, "start"]
    updates = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), params)
    adjusted = method.adjust_updates(updates, state)
    for update, owner in zip(arrays(adjusted), arrays(state.owners), strict=True):
        assert (update[owner != FREE] == 0).all()


def test_a_learned_task_never_changes(method, stages):
    for task in range(SPEC.tasks):
        params, state = stages[task, "end"]
        policy = method.policy(params, state, task)
        # It is what the finetuning ended with.
        same(policy, stages[task, "finetuned"][0])
        output = method.act(policy, OBSERVATION)
        for later in range(task + 1, SPEC.tasks):
            for stage in ("start", "trained", "pruned", "finetuned", "end"):
                again = method.policy(*stages[later, stage], task)
                same(policy, again)
                same(output, method.act(again, OBSERVATION))


def test_tasks_are_played_by_what_they_and_those_before_own(method, stages):
    params, state = stages[2, "end"]
    outputs = []
    for task in range(3):
        layers = [
            np.where((owner >= 0) & (owner <= task), x, 0)
            for x, owner in zip(arrays(params), arrays(state.owners), strict=True)
        ]
        outputs.append(played(layers)[0])
        actual = method.act(method.policy(params, state, task), OBSERVATION)
        for a, b in zip(actual, played(layers), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    assert not np.allclose(outputs[0], outputs[1])
    assert not np.allclose(outputs[1], outputs[2])
    # A task not yet learned gets the latest.
    same(method.policy(params, state, 3), method.policy(params, state, 2))


def test_before_training_the_policy_is_the_first_one(method):
    params, state = method.init(KEY)
    for task in range(SPEC.tasks):
        same(method.policy(params, state, task), params)


def test_training_plays_owned_and_free_weights_together(method, stages):
    for task in (0, 1):
        for stage in ("trained", "finetuned"):
            params, state = stages[task, stage]
            actual = method.distribution(params, state, (), OBSERVATION)
            for a, b in zip(actual, played(arrays(params)), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_a_full_network_stays_as_it_is():
    method = make(keep=0.5)
    stages = after_tasks(method, 4)
    params, state = stages[1, "end"]
    assert all((owner != FREE).all() for owner in arrays(state.owners))
    for task in (2, 3):
        same(stages[task, "end"][0], params)
        same(method.policy(*stages[task, "end"], task), params)


def test_the_size_is_that_of_two_networks(method, stages):
    base = sum(int(np.prod(shape)) for shape in SHAPES)
    for state in stages.values():
        assert method.size(*state) == 2 * base


def test_members_differ_in_their_share_and_are_the_same_alone():
    shares = jnp.asarray([0.25, 0.5])

    def member(keep, key):
        method = packnet.packnet(SPEC, PackNetSettings(keep=keep))
        params, state = method.init(key)
        params, state = method.consolidate(key, params, state, 0, None)
        params, state = method.end_task(params, state, 0, None)
        return method.policy(params, state, 0), state

    keys = jax.random.split(KEY, 2)
    crowd = jax.jit(jax.vmap(member))(shares, keys)
    alone = jax.jit(member)
    for number, keep in enumerate(shares):
        policy, state = one = alone(keep, keys[number])
        same(one, jax.tree.map(operator.itemgetter(number), crowd))
        for x, owner in zip(arrays(policy), arrays(state.owners), strict=True):
            assert np.sum(owner == 0) == np.ceil(keep * x.size)
            assert np.sum(x != 0) == np.sum(owner == 0)


def test_presets_leave_room_for_a_round_of_tasks():
    published = packnet.preset("halfcheetah/forgetting", 4, "paper")
    assert (published.keep, published.finetune) == (0.125, 0.1)
    assert packnet.preset("humanoid/hard", 4, "paper").finetune == 0.05
    assert packnet.preset("continual_world/cw10", 10, "paper").keep == 0.1
    assert make(finetune=0.2).offline == 0.2


@pytest.mark.parametrize(("policy", "target"), [(2, 4), (4, 2), (2, 3), (1, 1)])
def test_the_authors_targets_move_only_with_the_policy(policy, target):
    sac = SacSettings(policy_delay=policy, target_delay=target)
    nested = make(finetune_targets="nested").offline_sac(sac)
    moves = [n for n in range(48) if n % policy == 0 and n % target == 0]
    assert moves == [n for n in range(48) if n % nested.target_delay == 0]
    assert nested.policy_delay == policy
    assert make().offline_sac(sac) == sac


@pytest.mark.parametrize(
    ("values", "flag"),
    [
        ({"keep": 0.0}, "--keep"),
        ({"keep": 1.1}, "--keep"),
        ({"finetune": -0.1}, "--finetune"),
        ({"finetune": np.inf}, "--finetune"),
    ],
)
def test_settings_without_sense_are_refused(values, flag):
    with pytest.raises(UserError, match=flag):
        PackNetSettings(**values).checked()
