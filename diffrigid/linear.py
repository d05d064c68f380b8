"""Matrices with batch axes: products, and the solution of regular systems."""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from diffrigid.fence import at_hand
from diffrigid.gathers import MANY, fold
from diffrigid.numerics import safe_divide

UNROLLED = 6  # rows of a matrix, up to which its elimination is unrolled

# Otherwise a GPU rounds factors in single precision to ten bits.
matmul = functools.partial(jnp.matmul, precision=lax.Precision.HIGHEST)
einsum = functools.partial(jnp.einsum, precision=lax.Precision.HIGHEST)


def solve_regular(matrix: Array, right: Array) -> Array:
    """Solve matrix x = right for x, with regular matrices, (R, R, *batch), (R, *batch) -> (R, *batch).

    Linear in `right`, also for transposition; not differentiated with respect to the matrix. Where a matrix is singular
    the result is finite, but no solution.
    """
    matrix = lax.stop_gradient(matrix)

    def by(matrix: Array) -> Callable[[Any, Array], Array]:
        return lambda _, u: _eliminated(matrix, u)

    back = by(jnp.swapaxes(matrix, 0, 1))
    return lax.custom_linear_solve(functools.partial(matvec, matrix), right, by(matrix), transpose_solve=back)


def _eliminated(matrix: Array, right: Array) -> Array:
    system = jnp.concatenate([matrix, right[:, None]], axis=1)
    if len(matrix) <= UNROLLED:
        return _written_out(system)
    # Not fused; otherwise everything that the matrix is made of is computed in the order of the transposed one.
    system = at_hand(system)
    # What elimination makes of the right side beside the matrix needs no permutation. With a row below the system is
    # square: libraries for GPUs take a batch of these at once, others one by one.
    count = len(matrix)
    square = jnp.concatenate([system, jnp.zeros_like(system[:1])])
    factors = lax.linalg.lu(jnp.moveaxis(square, (0, 1), (-2, -1)))[0][..., :count, :]
    x = lax.linalg.triangular_solve(factors[..., :count], factors[..., count:], left_side=True)[..., 0]
    return jnp.moveaxis(jnp.where(jnp.isfinite(x), x, 0.0), -1, 0)


def matvec(matrix: Array, u: Array) -> Array:
    """Product of matrices (R, R, *batch) and vectors (R, *batch)."""
    parts = matrix * u[None]
    return fold(jnp.add, parts, 1) if len(u) <= MANY else parts.sum(1)


def identity(like: Array) -> Array:
    """Unit matrices, (R, R, *batch)."""
    size, batch = like.shape[0], like.shape[2:]
    return jnp.eye(size, dtype=like.dtype).reshape(size, size, *[1] * len(batch)) + jnp.zeros_like(like)


def _written_out(system: Array) -> Array:
    """Solve a system given as a matrix beside its right side, (R, R + 1, *batch) -> (R, *batch), without pivoting.

    Pivoting is not needed where the matrix is the product of a block-diagonal one and one with a positive definite
    symmetric part, as that of a body is except for strong friction. A direction whose pivot is 0 is left out.
    """
    eliminated = []
    while len(system):
        pivot = system[0, 0]
        eliminated.append(system[0, 1:] * safe_divide(jnp.ones_like(pivot), pivot)[None])
        system = system[1:, 1:] - system[1:, :1] * eliminated[-1][None]
    x: list[Array] = []
    for row in reversed(eliminated):
        x.insert(0, functools.reduce(jnp.subtract, [a * b for a, b in zip(row[:-1], x, strict=True)], row[-1]))
    return jnp.stack(x)
