"""Every two bodies once, without gathers: all of one half against all of the other, then the halves of each half.

Numbers of pairs lie in arrays (G, A, B, *batch): G groups, in each A bodies against B colliders. Against a table of all
bodies by all bodies this halves the work.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.contact.slots import Table
from diffrigid.gathers import constant, fold


class Block(NamedTuple):
    """Pairs of the same kind, in G groups: known when tracing."""

    a: np.ndarray  # (G, A) int: bodies
    b: np.ndarray  # (G, B) int: colliders
    halves: bool  # of each group these are both halves, N = G (A + B); else a are all N bodies

    @property
    def sides(self) -> tuple[tuple[int, np.ndarray], ...]:
        """For each half whose bodies are asked for, the axis of the others and their indices."""
        return ((2, self.b), (1, self.a))[: 1 + self.halves]


def blocks_of(table: Table, moving: int) -> list[Block]:
    """Blocks of all bodies against statics, or against each other."""
    bodies = np.arange(moving)[None]
    if table.b[0] >= moving:
        return [Block(bodies, np.array(table.b)[None], halves=False)]
    blocks = []
    while bodies.shape[1] % 2 == 0:
        a, b = np.split(bodies, 2, axis=1)
        blocks.append(Block(a, b, halves=True))
        bodies = np.stack([a, b], axis=1).reshape(-1, a.shape[1])
    # An odd number of bodies has no halves: there, every pair is found twice.
    return blocks + [Block(bodies, bodies, halves=False)] * (bodies.shape[1] > 1)


def grouped(block: Block, of_bodies: Array) -> tuple[Array, Array]:
    """Values (N, ...) of all bodies as those of a (G, A, ...), and of b, if these are bodies too (G, B, ...)."""
    groups = of_bodies.reshape(len(block.a), len(block.sides), -1, *of_bodies.shape[1:])
    return groups[:, 0], groups[:, -1]


def of_all(halves: list[Array]) -> Array:
    """Values (N, *batch) of all bodies from those of their halves (G, A, *batch)."""
    return jnp.stack(halves, axis=1).reshape(-1, *halves[0].shape[2:])


def soonest(block: Block, times: Array) -> list[Array]:
    """The least of the times of each body, by halves."""
    return [fold(jnp.minimum, times, axis) for axis, _ in block.sides]


def sum_of_met(block: Block, many: int, times: Array, until: Array) -> list[Array]:
    """Sum of index + `many` over the colliders that each body meets `until` (N, *batch), by halves."""

    def met(until: Array, axis: int, others: np.ndarray) -> Array:
        def term(k: int) -> Array:
            number = constant(tuple((many + others[:, k]).tolist()), str(times.dtype))
            number = number.reshape(-1, *[1] * (times.ndim - 2))
            return jnp.where(lax.index_in_dim(times, k, axis, keepdims=False) <= until, number, 0.0)

        return sum(map(term, range(others.shape[1])), jnp.zeros_like(until))

    return [met(own, *side) for own, side in zip(grouped(block, until), block.sides, strict=False)]


def where_allowed(table: Table, block: Block, times: Array) -> Array:
    """The times, inf where the two cannot meet."""
    column = np.searchsorted(table.b, block.b)
    allowed = np.array(table.allowed)[block.a[:, :, None], column[:, None]]
    if ((allowed > 0) | (block.a[:, :, None] == block.b[:, None])).all():
        return times
    kept = constant(tuple(allowed.ravel().tolist()), str(times.dtype)).reshape(*allowed.shape, *[1] * (times.ndim - 3))
    return jnp.where(kept > 0, times, jnp.inf)
