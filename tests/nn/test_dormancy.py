import itertools

import jax
import numpy as np
import pytest

from rewire_jax.nn import dormancy, networks

RANDOM = np.random.default_rng(0)


def test_dormant_neurons_are_those_of_the_definition():
    activations = RANDOM.normal(size=(2, 30, 7)).astype(np.float32)
    activations[0, :, 2] *= 0.01
    activations[1, :, 5] = 0
    activations[1, :, 6] -= 1000  # far from 0 on the other side
    got = dormancy.dormant(activations, 0.025)
    for critic, layer in enumerate(activations):
        sizes = [np.mean([abs(row[n]) for row in layer]) for n in range(7)]
        wanted = [size / np.mean(sizes) <= 0.025 for size in sizes]
        np.testing.assert_array_equal(got[critic], wanted)
    # Beside so large a neuron, all others are.
    assert np.asarray(got).sum(axis=1).tolist() == [1, 6]


def test_no_neuron_is_dormant_where_all_are_alike():
    assert not dormancy.dormant(np.ones((5, 3), np.float32), 0.99).any()
    # In a layer of zeros the definition divides 0 by 0.
    assert dormancy.dormant(np.zeros((5, 3), np.float32), 0.0).all()


@pytest.mark.parametrize("rank", [1, 4, 8])
def test_equal_directions_count_as_their_number(rank):
    left, _ = np.linalg.qr(RANDOM.normal(size=(20, rank)))
    right, _ = np.linalg.qr(RANDOM.normal(size=(8, rank)))
    features = (3 * left @ right.T).astype(np.float32)
    assert dormancy.effective_rank(features) == pytest.approx(rank, rel=1e-3)


def test_the_effective_rank_is_that_of_the_formula():
    features = RANDOM.normal(size=(2, 20, 8)) * np.arange(1, 9)
    for matrix, got in zip(
        features, dormancy.effective_rank(features.astype(np.float32)), strict=True
    ):
        # The singular values from the other side: roots of eigenvalues.
        values = np.sqrt(np.linalg.eigvalsh(matrix.T @ matrix))
        shares = values / values.sum()
        assert got == pytest.approx(np.prod(shares**-shares), rel=1e-4)
    zeros = np.zeros((4, 3), np.float32)
    assert dormancy.effective_rank(zeros) == pytest.approx(1)


def test_renewed_neurons_and_no_other_numbers_change():
    sizes = [3, 5, 4, 2]
    keys = jax.random.split(jax.random.key(0))
    layers, fresh = (networks.init_mlp(key, sizes) for key in keys)
    assert networks.sizes(layers) == sizes
    neurons = [np.isin(np.arange(5), [1, 4]), np.isin(np.arange(4), [2])]
    renewed = dormancy.renew(layers, neurons, fresh)
    assert jax.tree.structure(renewed) == jax.tree.structure(layers)
    for number, (old, new, got) in enumerate(zip(layers, fresh, renewed, strict=True)):
        outputs, inputs = old.weight.shape
        chosen = neurons[number] if number < 2 else np.zeros(outputs, bool)
        below = neurons[number - 1] if number > 0 else np.zeros(inputs, bool)
        for output, place in itertools.product(range(outputs), range(inputs)):
            wanted = (new if chosen[output] else old).weight[output, place]
            if below[place]:
                wanted = 0
            assert got.weight[output, place] == wanted
        for output in range(outputs):
            assert got.bias[output] == (new if chosen[output] else old).bias[output]


@pytest.mark.parametrize("network", networks.ACTIVATIONS)
def test_hidden_activations_lead_to_the_output(network):
    activation = networks.ACTIVATIONS[network]
    layers = networks.init_mlp(jax.random.key(0), [3, 5, 5, 2])
    x = RANDOM.normal(size=(6, 3)).astype(np.float32)
    hidden = networks.hidden_activations(layers, x, activation)
    assert [each.shape for each in hidden] == [(6, 5), (6, 5)]
    output = networks.affine(layers[-1], hidden[-1])
    np.testing.assert_allclose(output, networks.mlp(layers, x, activation), rtol=1e-4)
