"""Systems of a batch: residuals to rounding, however badly conditioned; singular ones stay finite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrigid.linear import UNROLLED, matvec, solve_regular

STIFF = 1e8  # of what contacts that stick hold, beside the masses that they hold


def held_bodies(rng, size):
    """1 + G K: mobilities of a linkage whose last bodies contacts hold stiffly, (size, size)."""
    inverse_mass = np.diag(10.0 ** rng.uniform(-2, 2, size))
    joints, contacts = rng.normal(size=(2, size)), rng.normal(size=(size // 2, size))
    joints[:, -size // 3 :], contacts[:, : size // 3], contacts[::2, : -size // 3] = 0.0, 0.0, 0.0
    response = np.linalg.solve(joints @ inverse_mass @ joints.T, joints @ inverse_mass)
    mobility = inverse_mass - inverse_mass @ joints.T @ response
    return np.eye(size) + mobility @ (STIFF * contacts.T @ contacts)


@pytest.mark.parametrize("size", [UNROLLED, 2 * UNROLLED])
@pytest.mark.parametrize("transposed", [False, True])
def test_residuals_of_stiff_systems_are_of_the_order_of_rounding(size, transposed):
    rng = np.random.default_rng(size)
    matrix = jnp.asarray(np.stack([held_bodies(rng, size) for _ in range(100)], axis=-1))
    right = jnp.asarray(rng.normal(size=(size, 100)))

    @jax.jit
    def solve(right):
        return solve_regular(matrix, right)

    x = jax.jit(jax.linear_transpose(solve, right))(right)[0] if transposed else solve(right)
    whole = jnp.swapaxes(matrix, 0, 1) if transposed else matrix
    left = np.linalg.norm(matvec(whole, x) - right, axis=0)
    assert np.all(left < 1e-13 * np.linalg.norm(whole, axis=(0, 1)) * np.linalg.norm(x, axis=0))


@pytest.mark.parametrize("size", [UNROLLED, 2 * UNROLLED])
def test_singular_systems_give_finite_numbers(size):
    matrix = jnp.zeros((size, size, 1)).at[0, 0].set(2.0)
    x = solve_regular(matrix, jnp.ones((size, 1)))
    assert np.all(np.isfinite(x))
    assert x[0, 0] == 0.5 or size > UNROLLED
