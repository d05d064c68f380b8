"""Systems of equations between the joints of a world, solved by blocks, many joints at a time.

The matrix J M^-1 J^T has a block for every joint, and one for every two joints with a body in common. A set of joints
of which no two are coupled is eliminated at once, then a set of those that are left, and so on; in a chain every
second joint goes first, so that 100 links take seven such levels. Which joints those are, and which blocks fill in,
is found when tracing, from which bodies are joined.

The matrix is positive semidefinite, so no pivoting is needed. Where joints form loops, an equation may repeat others:
its pivot is rounding, by which nothing can be divided. So a little is added to the diagonal there, much more than
rounding, and the solution refined: it is then one of many, and finite. Where joints form a tree there is none.
Source: George & Liu, Computer Solution of Large Sparse Positive Definite Systems, 1981, chapters 4 and 5;
for what is added to the diagonal Riley, Mathematical Tables and Other Aids to Computation 9 (1955) 96;
for every second joint of a chain Hockney 1965 (cyclic reduction); for joints Baraff, Linear-time dynamics using
Lagrange multipliers, SIGGRAPH 1996.
"""

import functools
from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.fence import unfused
from diffrigid.gathers import rows

YIELDING = 0.6  # eps to this power, of the diagonal, is added to it where joints form loops
REFINEMENTS = 2  # rounds after which a solution is that without this


class Level(NamedTuple):
    """One level of the elimination: P joints with up to S neighbours each, as indices into what is left before it.

    -1 stands for a block or a row of zeros.
    """

    pivots: tuple[int, ...]  # (P,) rows
    blocks: tuple[tuple[int, ...], ...]  # (P, 1 + S) blocks of each pivot with itself and its neighbours
    after: tuple[tuple[int, ...], ...]  # (P, S) the neighbours, among the solutions of later levels
    kept: tuple[int, ...]  # blocks that are left after it
    sums: tuple[tuple[int, ...], ...]  # for each of them, the products (P S S) to take off
    kept_rows: tuple[int, ...]
    row_sums: tuple[tuple[int, ...], ...]  # for each row that is left, the products (P S) to take off


class Plan(NamedTuple):
    """Plan for solving the system of n joints."""

    pairs: tuple[tuple[int, int], ...]  # of coupled joints, the one eliminated first in front
    levels: tuple[Level, ...]
    places: tuple[int, ...]  # (n,) of the joints among the solutions
    is_tree: bool


@functools.cache
def plan_of(ends: tuple[tuple[int, int], ...], moving: int) -> Plan:
    """Make the plan for joints between these colliders; those from `moving` on are static, and couple nothing."""
    on = [{body for body in pair if body < moving} for pair in ends]
    graph = {i: {j for j in range(len(on)) if j != i and on[i] & on[j]} for i in range(len(on))}
    sets = _independent_sets({i: set(near) for i, near in graph.items()})
    order = [i for level in sets for i in level]
    first = {i: k for k, i in enumerate(order)}.__getitem__
    pairs = tuple(sorted((i, j) for i in graph for j in graph[i] if first(i) < first(j)))
    blocks, left, levels = [(i, i) for i in range(len(on))] + list(pairs), list(range(len(on))), []
    for k, pivots in enumerate(sets):
        later = [i for level in reversed(sets[k + 1 :]) for i in level]
        level, blocks, left = _level(pivots, blocks, left, later, first)
        levels.append(level)
    solutions = [i for level in reversed(sets) for i in level]
    places = tuple(solutions.index(i) for i in range(len(on)))
    is_tree = len(ends) == moving + 1 - len(set(islands(grounded(ends, moving), moving + 1)))
    return Plan(pairs=pairs, levels=tuple(levels), places=places, is_tree=is_tree)


def _independent_sets(graph: dict[int, set[int]]) -> list[list[int]]:
    """Sets of joints to eliminate one after the other, those with few neighbours first. Empties the graph."""
    sets = []
    while graph:
        most, chosen, near = max(2, min(map(len, graph.values()))), [], set()
        for i in sorted(graph, key=lambda i: (len(graph[i]), i)):
            if i not in near and len(graph[i]) <= most:
                chosen.append(i)
                near |= graph[i]
        for i in chosen:
            around = graph.pop(i)
            for j in around:
                graph[j] = (graph[j] | around) - {i, j}
        sets.append(sorted(chosen))
    return sets


def _level(pivots, blocks, left, later, first) -> tuple[Level, list, list]:
    """A level, and the blocks and rows that are left after it."""
    near = {i: sorted({j for pair in blocks if i in pair for j in pair} - {i}, key=first) for i in pivots}
    most = max(map(len, near.values()))
    products: dict[tuple[int, int], list[int]] = {}
    row_products: dict[int, list[int]] = {}
    for p, i in enumerate(pivots):
        for s, j in enumerate(near[i]):
            row_products.setdefault(j, []).append(p * most + s)
            for t, k in enumerate(near[i]):
                if first(j) <= first(k):
                    products.setdefault((j, k), []).append((p * most + s) * most + t)
    kept = sorted({b for b in blocks if not set(b) & set(pivots)} | set(products))
    kept_rows = [i for i in left if i not in pivots]

    def at(found, items):
        return tuple(found.index(item) if item in found else -1 for item in items)

    def padded(lists, size):
        return tuple(tuple(items) + (-1,) * (size - len(items)) for items in lists)

    def terms(table, items):
        lists = [table.get(item, []) for item in items]
        return padded(lists, max(map(len, lists), default=0))

    level = Level(
        pivots=at(left, pivots),
        blocks=padded([at(blocks, [(i, i), *((i, j) for j in near[i])]) for i in pivots], 1 + most),
        after=padded([at(later, near[i]) for i in pivots], most),
        kept=at(blocks, kept),
        sums=terms(products, kept),
        kept_rows=at(left, kept_rows),
        row_sums=terms(row_products, kept_rows),
    )
    return level, kept, kept_rows


def grounded(ends: Iterable[tuple[int, int]], moving: int) -> list[tuple[int, int]]:
    """The ends of pairs, all statics counted as one body."""
    return [(min(a, moving), min(b, moving)) for a, b in ends]


def islands(ends: Iterable[tuple[int, int]], moving: int) -> tuple[tuple[int, ...], ...]:
    """Moving bodies connected with each moving body through pairs with these ends, itself included, in order."""
    together = [{body} for body in range(moving)]
    for a, b in ends:
        if a < moving and b < moving and together[a] is not together[b]:
            together[a] |= together[b]
            for body in together[b]:
                together[body] = together[a]
    return tuple(tuple(sorted(bodies)) for bodies in together)


class Factor(NamedTuple):
    """Factors of one level."""

    inverse: Array  # (P, E, E, *batch) of the blocks of the pivots
    near: Array  # (P, S, E, E, *batch) inverse times the blocks with the neighbours


def factorise(plan: Plan, blocks: Array) -> tuple[Factor, ...]:
    """Factors of all levels, from blocks (n + pairs, E, E, *batch) of joints with themselves, then of `plan.pairs`."""
    if not plan.is_tree:
        own = blocks[: len(plan.places)]
        diagonal = jnp.eye(own.shape[1], dtype=own.dtype).reshape(*own.shape[1:3], *[1] * (own.ndim - 3))
        yielding = float(jnp.finfo(own.dtype).eps) ** YIELDING
        blocks = jnp.concatenate([own + yielding * diagonal[None] * own, blocks[len(own) :]])
    factors = []
    for level in plan.levels:
        own = rows(blocks, level.blocks)
        inverse, near = unfused(_inverse, own[:, 0]), own[:, 1:]
        ready = _product(inverse[:, None], near, 2)
        factors.append(Factor(inverse, ready))
        if level.kept:
            product = _product(jnp.swapaxes(near, 2, 3)[:, :, None], ready[:, None], 3)
            taken = product.reshape(-1, *product.shape[3:])
            blocks = _less(rows(blocks, level.kept), taken, level.sums)
    return tuple(factors)


def solve(plan: Plan, factors: tuple[Factor, ...], product: Callable[[Array], Array], right: Array) -> Array:
    """Solve for a right-hand side (n, E, *batch); `product` multiplies by the matrix."""
    x = _substituted(plan, factors, right)
    for _ in range(0 if plan.is_tree else REFINEMENTS):
        x = x + _substituted(plan, factors, right - product(x))
    return x


def _substituted(plan: Plan, factors: tuple[Factor, ...], right: Array) -> Array:
    pivots, right = [], right[:, :, None]
    for level, factor in zip(plan.levels, factors, strict=True):
        own = rows(right, level.pivots)
        pivots.append(own)
        if level.kept_rows:
            taken = _product(jnp.swapaxes(factor.near, 2, 3), own[:, None], 2)
            taken = taken.reshape(-1, *taken.shape[2:])
            right = _less(rows(right, level.kept_rows), taken, level.row_sums)
    x = right[:0]
    for level, factor, own in list(zip(plan.levels, factors, pivots, strict=True))[::-1]:
        found = _product(factor.inverse, own, 1)
        if level.after[0]:
            found = found - _product(factor.near, rows(x, level.after), 2).sum(1)
        x = jnp.concatenate([x, found])
    return rows(x, plan.places)[:, :, 0]


def _inverse(matrix: Array) -> Array:
    """Invert matrices (P, E, E, *batch) by sweeps (Beaton 1964); pivots of zero are left out."""

    def sweep(k, matrix):
        column = lax.dynamic_index_in_dim(matrix, k, 2, keepdims=False)
        pivot = lax.dynamic_index_in_dim(column, k, 1, keepdims=False)
        usable = pivot > 0
        share = jnp.where(usable, -1.0 / jnp.where(usable, pivot, 1.0), 0.0)[:, None]
        hit = lax.broadcasted_iota(np.int32, column.shape, 1) == k
        row = lax.dynamic_index_in_dim(matrix, k, 1, keepdims=False)
        column, row = jnp.where(hit, -1.0, column), jnp.where(hit, -1.0, row) * share
        rest = jnp.where(hit[:, :, None] | hit[:, None], 0.0, matrix)
        return rest + column[:, :, None] * row[:, None]

    return -lax.fori_loop(0, matrix.shape[1], sweep, matrix, unroll=matrix.shape[1] <= 3)


def _product(a: Array, b: Array, axis: int) -> Array:
    """Multiply matrices with rows on `axis`, columns after it. Term by term: XLA does not vectorise a short sum."""

    def term(k):
        return lax.slice_in_dim(a, k, k + 1, axis=axis + 1) * lax.slice_in_dim(b, k, k + 1, axis=axis)

    return functools.reduce(jnp.add, map(term, range(b.shape[axis])))


def _less(values: Array, taken: Array, sums: tuple[tuple[int, ...], ...]) -> Array:
    """Subtract from each of the values (K, ...) those of `taken` that `sums` lists for it."""
    return values if not sums[0] else values - rows(taken, sums).sum(1)
