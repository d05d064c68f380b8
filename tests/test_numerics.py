"""Cosine and sine to rounding over thousands of turns; what replaces functions where these have no derivative."""

from decimal import Decimal, localcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from diffrigid.numerics import _PI, cos_sin, implicit_root, norm, normalise, safe_divide, safe_sqrt, softplus

RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("most", [0.1, np.pi, 6e3])  # [rad]
def test_cosine_and_sine(dtype, most):
    quarters = 0.5 * np.pi * np.round(most * np.linspace(-0.6, 0.6, 41))
    phi = np.concatenate([RANDOM.uniform(-most, most, 10_000), quarters[np.abs(quarters) <= most]]).astype(dtype)
    known = np.cos(phi.astype(np.longdouble)), np.sin(phi.astype(np.longdouble))
    for found, value in zip(jax.jit(cos_sin)(phi), known, strict=True):
        assert found.dtype == dtype
        assert np.abs(np.asarray(found, np.longdouble) - value).max() < 1.3 * np.finfo(dtype).eps


@pytest.mark.parametrize(("dtype", "error"), [(np.float32, 1e-14), (np.float64, 1e-32)])
def test_parts_of_pi(dtype, error):
    parts = [Decimal(float(dtype(part))) for part in _PI[np.finfo(dtype).bits]]
    with localcontext(prec=60):
        assert abs(sum(parts) - Decimal("3.14159265358979323846264338327950288419716939937510")) < error
        for part in parts[:-1]:  # their products with small integers are exact
            assert all(Decimal(float(dtype(part) * dtype(n))) == part * n for n in range(1, 1000))


def test_derivatives_of_cosine_and_sine():
    phi, along = jnp.array([0.0, 0.3, -2.0, 4.0, 50.0]), jnp.array([1.0, -2.0, 0.5, 3.0, 1.0])
    (c, s), (dc, ds) = jax.jvp(cos_sin, (phi,), (along,))
    assert_allclose(dc, -s * along, rtol=1e-15)
    assert_allclose(ds, c * along, rtol=1e-15)
    (back,) = jax.vjp(cos_sin, phi)[1]((along, 2.0 * along))
    assert_allclose(back, (2.0 * c - s) * along, rtol=1e-14)
    second = jax.vmap(jax.jacfwd(jax.grad(lambda phi: cos_sin(phi)[0])))(phi)
    assert_allclose(second, -c, rtol=1e-14)


AT = [  # function, arguments, value, derivatives
    (safe_sqrt, (4.0,), 2.0, (0.25,)),
    (safe_sqrt, (0.0,), 0.0, (0.0,)),
    (safe_sqrt, (-1.0,), 0.0, (0.0,)),
    (safe_divide, (3.0, 2.0), 1.5, (0.5, -0.75)),
    (safe_divide, (3.0, 0.0), 0.0, (0.0, 0.0)),
    (safe_divide, (0.0, 0.0), 0.0, (0.0, 0.0)),
    (safe_divide, (1.0, 1e-25), 1e25, (1e25, -np.inf)),  # of 1 / b alone; -1 / b^2 is beyond single precision
    (lambda x, y: norm(jnp.stack([x, y])), (3.0, 4.0), 5.0, (0.6, 0.8)),
    (lambda x, y: norm(jnp.stack([x, y])), (0.0, 0.0), 0.0, (0.0, 0.0)),
    (lambda x, y: normalise(jnp.stack([x, y]))[0], (3.0, 4.0), 0.6, (16 / 125, -12 / 125)),
    (lambda x, y: normalise(jnp.stack([x, y]))[0], (0.0, 0.0), 0.0, (0.0, 0.0)),
    (softplus, (0.0, 0.5), 0.5 * np.log(2.0), (0.5, np.log(2.0))),
    (softplus, (2.0, 0.0), 2.0, (1.0, 0.0)),
    (softplus, (-2.0, 0.0), 0.0, (0.0, 0.0)),
]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_values_and_derivatives_where_there_are_none(dtype, derivative):
    for fn, at, value, slopes in AT:
        arguments = [jnp.asarray(number, dtype) for number in at]
        assert_allclose(fn(*arguments), value, rtol=1e-6, err_msg=f"{fn} {at}")
        found = derivative(fn, tuple(range(len(at))))(*arguments)
        for one, expected in zip(found, slopes, strict=True):
            assert one.dtype == dtype and not np.isnan(one)
            if np.isfinite(expected):
                assert_allclose(one, expected, rtol=1e-6, err_msg=f"{fn} {at}")


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_a_root_moves_as_its_equation_does(derivative):
    """s^2 = p: ds/dp = 1 / (2 s); 0 where the equation has no slope."""

    def root(p, s):
        s = jax.lax.stop_gradient(s)
        return implicit_root(s, s * s - p, 2.0 * s)

    assert_allclose(derivative(root)(4.0, 2.0), 0.25, rtol=1e-15)
    assert derivative(root)(0.0, 0.0) == 0.0
    with pytest.raises(NotImplementedError):
        derivative(jax.grad(root))(4.0, 2.0)
