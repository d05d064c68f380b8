"""Rows that are picked and summed by an index known when tracing: as a matrix does it, in both modes, and mapped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from diffrigid.gathers import rows, sum_rows

COUNT = 4
VALUES = np.random.default_rng(0).normal(size=(COUNT, 3, 2))
CASES = {
    "flat": (rows, (0, 2, 2, 1)),
    "run": (rows, (1, 2, 3)),
    "one": (rows, (2, 2, 2)),
    "table": (rows, ((0, 2), (1, 1), (3, 0))),
    "zeros": (rows, (2, -1, 0, 0)),
    "nothing": (rows, (-1, -1)),
    "table with zeros": (rows, ((0, -1, 3), (2, 2, -1))),
    "sums": (sum_rows, ((0, 2), (3, COUNT), (0, 1))),
    "sums of runs": (sum_rows, ((0, 1), (2, 3))),
}


def matrix(pick, index):
    """Of the linear map, from rows to rows."""
    chosen = np.vstack([np.eye(COUNT), np.zeros(COUNT)])[np.array(index)]  # the last row stands for nothing, also as -1
    return chosen.sum(1) if pick is sum_rows else chosen


@pytest.mark.parametrize("case", CASES)
def test_rows_are_those_of_a_matrix(case):
    pick, index = CASES[case]
    picks = matrix(pick, index)

    def expected(values):
        return jnp.tensordot(picks, values, 1)

    def cube(of):
        return lambda values: (of(values) ** 3).sum()

    def picked(values):
        return pick(values, index)

    values = jnp.asarray(VALUES)
    assert_allclose(picked(values), expected(values), atol=1e-15)
    assert_allclose(jax.jvp(picked, (values,), (values**2,))[1], expected(values**2), atol=1e-15)
    assert_allclose(jax.grad(cube(picked))(values), jax.grad(cube(expected))(values), atol=1e-14)
    assert_allclose(jax.hessian(cube(picked))(values), jax.hessian(cube(expected))(values), atol=1e-13)
    for axis in range(values.ndim + 1):
        many = jnp.stack([values, 2.0 * values], axis)
        for way in (lambda of: of, lambda of: jax.grad(cube(of))):
            assert_allclose(jax.vmap(way(picked), axis)(many), jax.vmap(way(expected), axis)(many), atol=1e-13)
    assert "scatter" not in str(jax.make_jaxpr(jax.grad(cube(picked)))(values))
