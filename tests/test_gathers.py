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

    def picked(values):
        return pick(values, index)

    def cube(of):
        return lambda values: (of(values) ** 3).sum()

    def in_all_ways(of):
        def ways(values):
            slope = jax.grad(cube(of))
            yield of(values)
            yield jax.jvp(of, (values,), (values**2,))[1]
            yield slope(values)
            yield jax.hessian(cube(of))(values)
            for axis in range(values.ndim + 1):
                many = jnp.stack([values, 2.0 * values], axis)
                yield from (jax.vmap(way, axis)(many) for way in (of, slope))

        return jax.jit(lambda values: tuple(ways(values)))

    values = jnp.asarray(VALUES)
    for got, exact in zip(in_all_ways(picked)(values), in_all_ways(expected)(values), strict=True):
        assert_allclose(got, exact, rtol=1e-13, atol=1e-13)
    assert "scatter" not in str(jax.make_jaxpr(jax.grad(cube(picked)))(values))
