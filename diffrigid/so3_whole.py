"""The verbs of `so3` for one world, without batch axes, as products of whole arrays.

These are fewer operations, which compile faster. For a batch `so3` writes them in components, because on a CPU XLA
does not vectorise sums of three terms. Vectors (3,), quaternions (4,), matrices (3, 3).
"""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.numerics import dot, half_turn


def whole(of_arrays: Callable, *ranks: int) -> Callable:
    """Decorator: use `of_arrays` where all arguments have these ranks, that is, no batch axes."""

    def decorate(by_components: Callable) -> Callable:
        @functools.wraps(by_components)
        def either(*args: Array) -> Array:
            alone = all(arg.ndim == rank for arg, rank in zip(args, ranks, strict=True))
            return (of_arrays if alone else by_components)(*args)

        return either

    return decorate


@functools.cache
def _constant(make: Callable[[], np.ndarray], dtype: Any) -> Any:
    """An array that is made once; see `gathers.constant`."""
    return make().astype(dtype)


def _levi_civita() -> np.ndarray:
    """(3, 3, 3): (a x b)_i = sum_jk [i, j, k] a_j b_k."""
    i, j, k = np.indices((3, 3, 3))
    return (i - j) * (j - k) * (k - i) / 2


def _hamilton() -> np.ndarray:
    """(4, 4, 4): (q p)_i = sum_jk [i, j, k] q_j p_k, for q = (s, u) and p = (t, v) (s t - u . v, s v + t u + u x v)."""
    table = np.zeros((4, 4, 4))
    table[0] = np.diag([1, -1, -1, -1])
    table[1:, 0, 1:] = table[1:, 1:, 0] = np.eye(3)
    table[1:, 1:, 1:] = _levi_civita()
    return table


def _as_quaternion() -> np.ndarray:
    """(4, 3): a vector as the quaternion without a real part."""
    return np.eye(4)[:, 1:]


def _conjugation() -> np.ndarray:
    return np.array([1, -1, -1, -1])


def matrix_product(m: Array, r: Array) -> Array:
    """Product of a matrix and a vector. As a sum: a product of matrices is a library call, compiled separately."""
    return (m * r[None]).sum(1)


def _matrices_product(a: Array, b: Array) -> Array:
    return (a[:, :, None] * b[None]).sum(1)


def skew(w: Array) -> Array:
    """Matrix of r -> w x r."""
    return (_constant(_levi_civita, w.dtype) * w[None, :, None]).sum(1)


def cross(w: Array, r: Array) -> Array:
    return matrix_product(skew(w), r)


def rotate(q: Array, r: Array) -> Array:
    """r + 2 s (u x r) + 2 u x (u x r)."""
    return _rotated(q[:1], skew(q[1:]), r)


def unrotate(q: Array, r: Array) -> Array:
    return _rotated(-q[:1], skew(q[1:]), r)


def _rotated(s: Array, U: Array, r: Array) -> Array:
    twice = 2.0 * matrix_product(U, r)
    return r + s * twice + matrix_product(U, twice)


def spin(inertia: Array, q: Array, w: Array) -> Array:
    """R I R^T w."""
    return rotate(q, matrix_product(inertia, unrotate(q, w)))


def world_inverse(inverse: Array, q: Array) -> Array:
    """R I^-1 R^T, with R = 1 + 2 s U + 2 U U."""
    U = skew(q[1:])
    R = jnp.eye(3, dtype=q.dtype) + 2.0 * (q[0] * U + _matrices_product(U, U))
    return _matrices_product(_matrices_product(R, inverse), R.T)


def exp(phi: Array) -> Array:
    """(cos, sin n) of half the angle |phi| about its axis n."""
    s, scale = half_turn(dot(phi, phi))
    real = jnp.eye(4, 1, dtype=phi.dtype)[:, 0]
    return s * real + matrix_product(_constant(_as_quaternion, phi.dtype), scale * phi)


def _product(q: Array, p: Array) -> Array:
    return matrix_product((_constant(_hamilton, q.dtype) * q[None, :, None]).sum(1), p)


def compose(q: Array, p: Array) -> Array:
    product = _product(q, p)
    return (1.5 - 0.5 * dot(product, product)) * product  # see `so3._unit_product`


def turn_by(phi: Array, q: Array) -> Array:
    return compose(exp(phi), q)


def turn_in_body(q: Array, phi: Array) -> Array:
    return compose(q, exp(phi))


def rate(w: Array, q: Array) -> Array:
    return 0.5 * _product(matrix_product(_constant(_as_quaternion, w.dtype), w), q)


def difference(q: Array, p: Array) -> Array:
    return compose(_constant(_conjugation, q.dtype) * q, p)
