"""The simulator against exact motions: values, and gradients that follow the impact times."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import BLOCK, CASES, build, exact, final, pulled_back, simulated, steps_near
from marks import some_later

EXACT = 1e-9  # relative: rounding of a few hundred steps, times the condition of up to three impacts
TOP = 1e-6  # truncation of the series for the turn of an unsymmetric body within a step, order 6
SINGLE = 1e-3  # the same in float32


def relative_errors(got, expected):
    """Entrywise |got - expected| / max(|expected|, 1 % of the largest in the row)."""
    expected = np.asarray(expected, float)
    largest = np.abs(expected).max(axis=1, keepdims=True)
    scale = np.maximum(np.abs(expected), 0.01 * np.where(largest > 0, largest, 100.0))
    return np.abs(np.asarray(got, float) - expected) / scale


def assert_follows(got, expected, tolerance):
    (state, jac), (exact_state, exact_jac) = got, expected
    np.testing.assert_allclose(state, exact_state, rtol=tolerance, atol=tolerance)
    errors = relative_errors(jac, exact_jac)
    assert errors.max() < tolerance, (
        f"{errors.max():.1e} at output, parameter {np.argwhere(errors >= tolerance).tolist()}"
    )


@pytest.mark.parametrize("rate", [60, 240])
@pytest.mark.parametrize("name", CASES)
def test_state_and_jacobian_are_exact(name, rate):
    case = CASES[name]
    got = simulated(case.scene, case.parameters, case.t, rate)
    assert_follows(got, exact(case), TOP if name == "top" else EXACT)


@some_later("name", ["discs that slide", "rod strikes"], "discs that slide")
def test_reverse_mode_is_forward_mode_in_every_leaf(name):
    case = CASES[name]
    world, state, _ = build(case.scene, case.parameters)
    blocks, dt = steps_near(case.t, 60)
    end, by_leaf = final(world, state, dt, blocks)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=end.shape))
    reverse = pulled_back(world, state, dt, blocks * BLOCK, weights)
    assert relative_errors(reverse[None], (weights @ by_leaf)[None]).max() < EXACT


@pytest.mark.parametrize("name", ["one bounce", "bounce that slides", "bounce that sticks"])
def test_single_precision(name):
    case = CASES[name]
    world, state, by_parameter = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), build(case.scene, case.parameters))
    blocks, dt = steps_near(case.t, 60)
    end, by_leaf = final(world, state, dt.astype(jnp.float32), blocks)
    assert end.dtype == by_leaf.dtype == jnp.float32
    assert_follows((end, by_leaf @ by_parameter), exact(case), SINGLE)
