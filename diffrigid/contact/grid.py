"""Neighbours among the bodies of a crowd, from a uniform grid, by sorting bodies by the index of their cell.

With the bodies sorted by cell, first axis fastest, those of three adjacent cells of a row are contiguous, so the
neighbours of a body lie in 3 stretches of that order in 2D, and 9 in 3D. All array shapes are static: only how far
the stretches are walked depends on positions. Source: Green, Particle Simulation using CUDA, 2010.
"""

import itertools
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from diffrigid.branches import any_world

CELLS = 4  # for each body
SPREAD = 2.5  # [-] half-width of the grid in standard deviations; bodies farther out count as on its edge


class Near(NamedTuple):
    """Neighbours of each of M bodies; the two of a pair list each other."""

    other: Array  # (E, M) int, indices of bodies; -1: none. Only the first E, if there are more
    found: Array  # (M,) int, how many there are, also beyond E


def neighbours(x: Array, reach: Array, worlds: int, most: int) -> Near:
    """Find all bodies closer to each other than the sum of their reaches; no derivatives.

    Args:
        x: (D, M) [m] of N bodies of `worlds` worlds, in this order of axes.
        reach: (M,) [m].
        most: E, capacity of the neighbour list of each body.
    """
    x, reach = lax.stop_gradient((x, reach))
    order, first, ends = _stretches(x, reach, worlds)
    me = lax.broadcasted_iota(order.dtype, order.shape, 0)
    room = lax.broadcasted_iota(order.dtype, (most, len(me)), 0)

    def look(carry: Any) -> Any:
        k, other, count = carry
        at = first[0] + k
        for begin, before in zip(first[1:], ends[:-1], strict=True):
            at = jnp.where(k >= before, begin + k - before, at)
        j = pick(order, jnp.minimum(at, len(me) - 1))
        away, both = x - pick(x, j), reach + pick(reach, j)
        near = (k < ends[-1]) & (j != me) & ((away * away).sum(0) < both * both)
        other = jnp.where(near[None] & (room == count[None]), j[None], other)
        return k + 1, other, count + near.astype(count.dtype)

    start = jnp.zeros_like(me[0]), jnp.full_like(room, -1), jnp.zeros_like(me)
    longest = ends[-1].max()
    _, other, count = lax.while_loop(lambda carry: any_world(carry[0] < longest), look, start)
    return Near(other, count)


def _stretches(x: Array, reach: Array, worlds: int) -> tuple[Array, list[Array], list[Array]]:
    """Order of the bodies by cell; for each body, the beginnings of its stretches, and their cumulative lengths."""
    dim, count = x.shape
    side = int((CELLS * count // worlds) ** (1.0 / dim)) + 1
    mean, deviation = x.mean(1, keepdims=True), x.std(1, keepdims=True)
    low = mean - SPREAD * deviation
    length = jnp.maximum(2.0 * reach.max(), 2.0 * SPREAD * deviation.max() / side)
    inside = jnp.clip(jnp.floor((x - low) / length), 0, side - 1).astype(jnp.int32) + 1  # a border stays empty
    strides = [(side + 2) ** d for d in range(dim)]
    cells = worlds * (side + 2) ** dim
    world = lax.broadcasted_iota(jnp.int32, (count,), 0) % worlds
    cell = world * (side + 2) ** dim + sum(stride * inside[d] for d, stride in enumerate(strides))
    begins = jnp.concatenate([jnp.zeros_like(cell[:1]), jnp.cumsum(jnp.zeros(cells, jnp.int32).at[cell].add(1))])
    first, ends, total = [], [], jnp.zeros_like(cell)
    for off in itertools.product((-1, 0, 1), repeat=dim - 1):
        row = cell + sum(o * stride for o, stride in zip(off, strides[1:], strict=True))
        begin = pick(begins, row - 1)
        total = total + pick(begins, row + 2) - begin
        first.append(begin)
        ends.append(total)
    return _in_order(cell, cells), first, ends


def _in_order(cell: Array, cells: int) -> Array:
    """Sort bodies by cell. Cell and body packed into one integer, where it fits, sort much faster."""
    count = len(cell)
    if cells * count >= 2**31:
        return jnp.argsort(cell)
    return jnp.sort(cell * count + lax.broadcasted_iota(cell.dtype, cell.shape, 0)) % count


def pick(values: Array, index: Array) -> Array:
    """Gather values[..., index]; every index must be in bounds."""
    return values.at[..., index].get(mode="promise_in_bounds", wrap_negative_indices=False)
