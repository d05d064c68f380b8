"""Impacts of round shapes that are alone on their bodies: the usual step of a world of many discs or spheres.

The general pass evaluates every contact of every pair. Here only the *times* are found for all pairs, on the
grid of bodies against bodies, in one kernel without derivative; then each body that is struck meets its one
partner. The partner is picked by a product with zeros and ones and summed over the grid, which unlike a gather
along the batch is vectorised, in both directions. 16 discs between walls run ten times as fast.

A pass goes this way if it is an impact pass and, in all worlds of the batch, no body is in two contacts at the
same time and none comes to rest; else the general way, to the same result.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.collide import PairGroup
from diffrigid.contact.impact import approach, closed_form
from diffrigid.contact.impulse import contact_law
from diffrigid.contact.sides import Side, side_of
from diffrigid.contact.strikes import MATERIALS, Material, material, mixed, relative_path_is_straight, strikes_of
from diffrigid.flight import Flight
from diffrigid.numerics import constant, dot, fence, packed_map, rows
from diffrigid.pytree import replace
from diffrigid.shapes import HalfSpace
from diffrigid.state import rotations

RESTS = -1e30  # [s] stands for an impact after which bodies stay together
CROWDED = 4  # pairs per body from which the grid is faster than the list of pairs


class Grid(NamedTuple):
    """All pairs of one kind as a table of A rows of side a and B of side b; `allowed` says which are pairs."""

    pairs: PairGroup
    rows_a: tuple[int, ...]  # of world.shapes
    rows_b: tuple[int, ...]
    a: tuple[int, ...]  # colliders
    b: tuple[int, ...]
    allowed: tuple[tuple[float, ...], ...]  # (A, B) 1 or 0


def is_crowded(world: Any) -> bool:
    """Whether a world is crowded with round shapes, whose impact times have a closed form. Static."""
    moving, count = len(world.names), sum(len(pairs.a) for pairs in world.pairs)

    def solved(pairs: PairGroup) -> bool:
        straight = relative_path_is_straight(world, max(pairs.a + pairs.b) < moving)
        return closed_form(world.shapes[pairs.shape_a], world.shapes[pairs.shape_b], straight)

    return count > CROWDED * moving and all(map(solved, world.pairs))


def grid_of(pairs: PairGroup) -> Grid:
    """The table that holds the pairs of a group."""
    row_of_a = dict(sorted(zip(pairs.a, pairs.row_a, strict=True)))
    row_of_b = dict(sorted(zip(pairs.b, pairs.row_b, strict=True)))
    there = set(zip(pairs.a, pairs.b, strict=True))
    allowed = tuple(tuple(float((i, j) in there) for j in row_of_b) for i in row_of_a)
    rows_a, rows_b = tuple(row_of_a.values()), tuple(row_of_b.values())
    return Grid(pairs, rows_a, rows_b, tuple(row_of_a), tuple(row_of_b), allowed)


def partners(world: Any, grids: tuple[Grid, ...], flight: Flight, since: Array, dt: Array):
    """Which pairs have an impact that is the next one of both bodies.

    Returns:
        for each grid (A, B, *batch) 1 for these pairs, else 0; whether they are isolated, exact and none rests,
        a bool; whether there are any, a bool.
    """
    moving, tie = len(world.names), jnp.sqrt(jnp.finfo(dt.dtype).eps) * dt
    live = jnp.any(dt > 0)
    times = fence(live, [_next_times(world, grid, flight, since, dt) for grid in grids])
    first = jnp.full((moving, *times[0].shape[2:]), jnp.inf, dt.dtype)
    for grid, s in zip(grids, times, strict=True):
        first = jnp.minimum(first, _at_bodies(_fold(jnp.minimum, s, 1), grid.a, moving, jnp.inf))
        first = jnp.minimum(first, _at_bodies(_fold(jnp.minimum, s, 0), grid.b, moving, jnp.inf))
    first = fence(live, first)
    isolated = jnp.all(first > RESTS) & ~jnp.any(world.contact.width > 0)
    nows, count = [], jnp.zeros_like(first)
    for grid, s in zip(grids, times, strict=True):
        earliest = rows(first, grid.a)[:, None]
        if min(grid.b) < moving:
            earliest = jnp.minimum(earliest, rows(first, grid.b)[None])
        nows.append((s - earliest <= tie[None, None]).astype(dt.dtype))  # inf - inf is not
    for grid, now in zip(grids, nows, strict=True):
        count = count + _at_bodies(_fold(jnp.add, now, 1), grid.a, moving, 0.0)
        count = count + _at_bodies(_fold(jnp.add, now, 0), grid.b, moving, 0.0)
    return nows, isolated & jnp.all(count <= 1), jnp.any(count > 0)


def _next_times(world: Any, grid: Grid, flight: Flight, since: Array, dt: Array) -> Array:
    """Time of the next impact of every pair, (A, B, *batch) [s]; inf: none in this step; RESTS: no rebound."""
    straight = relative_path_is_straight(world, max(grid.a + grid.b) < len(world.names))
    rest_speed = world.contact.rest_speed

    def one(a: Side, b: Side, allowed: Array, e_a: Material, e_b: Material) -> Array:
        s, _, found, u = approach(a, b, dt, None, straight)
        rests = u <= rest_speed
        if isinstance(b.shape, HalfSpace):  # seen from the other, the path of any other pair is straight
            n = rotations(b.x.shape[0]).rotate(b.q, b.shape.normal)
            rests = rests | (2.0 * mixed(e_a, e_b) * u <= -dot(n, a.flight.a) * (dt - s))
        return jnp.where(found & (s <= dt) & (allowed > 0), jnp.where(rests, RESTS, s), jnp.inf)

    a, b = _sides(world, grid, flight, since)
    own, others = (material(world, "restitution", colliders) for colliders in (grid.a, grid.b))
    return jax.vmap(jax.vmap(one, (None, 0, 0, None, 0)), (0, None, 0, 0, None))(a, b, _table(grid, dt), own, others)


class Blows(NamedTuple):
    """What the impacts of a pass do to each body."""

    hits: Array  # (N, *batch) 0 or 1
    s: Array  # (N, *batch) [s] sum of their times
    P: Array  # (N, D, *batch) [N s] sum of impulses
    turn: Array  # (N, A, *batch) [N m s] sum of r x P


def meet(world: Any, grids: tuple[Grid, ...], nows: list[Array], flight: Flight, since: Array, dt: Array) -> Blows:
    """Impacts of bodies with the one partner that each has now."""
    moving, so, live = len(world.names), rotations(flight.dim), jnp.any(dt > 0)
    parts = []
    for grid, now in zip(grids, nows, strict=True):
        a, b = _sides(world, grid, flight, since)
        own, others = ([material(world, name, colliders) for name in MATERIALS] for colliders in (grid.a, grid.b))
        partner, others = _pick(live, now, (b, others))
        e, mu = map(mixed, own, others)
        strikes = jax.vmap(lambda a, b: strikes_of(world, a, b, dt, jnp.asarray(False), None))(a, partner)
        k = fence(live, jax.tree.map(lambda leaf: leaf[:, 0], replace(strikes, gap=None, push=None, drift=None)))
        on = _fold(jnp.add, now, 1) * k.active.astype(now.dtype)
        target = -e * jax.vmap(dot)(k.normal, k.v_rel)
        P = jnp.where(on[:, None] > 0, jax.vmap(contact_law)(k.K, k.normal, k.v_rel, target, mu), 0.0)
        blows = Blows(on, on * k.s, P, jax.vmap(so.moment)(k.arm_a, P))
        blows, minus = fence(live, (blows, Blows(on, on * k.s, -P, jax.vmap(so.moment)(k.arm_b, -P))))
        parts.append(Blows(*(_at_bodies(value, grid.a, moving, 0.0) for value in blows)))
        if min(grid.b) < moving:
            blows = packed_map(functools.partial(_across, live, now), minus, now.ndim - 2)
            parts.append(Blows(*(_at_bodies(value, grid.b, moving, 0.0) for value in blows)))
    return jax.tree.map(lambda *values: sum(values), *parts)


def _across(live: Array, now: Array, values: Array) -> Array:
    """From the rows of side a, (A, F, *batch), to those of side b which they meet."""
    return fence(live, _weighted_sum(now, values, 0))


def _fold(op: Any, table: Array, axis: int) -> Array:
    """Reduction over the bodies on one axis of a table (A, B, *batch). Written out: XLA's own is slow."""
    return functools.reduce(op, (lax.index_in_dim(table, k, axis, keepdims=False) for k in range(table.shape[axis])))


def _sides(world: Any, grid: Grid, flight: Flight, since: Array) -> tuple[Side, Side]:
    a = side_of(world, flight, since, grid.pairs.shape_a, grid.rows_a, grid.a)
    return a, side_of(world, flight, since, grid.pairs.shape_b, grid.rows_b, grid.b)


def _pick(live: Array, now: Array, sides: Any) -> Any:
    """Of B sides, for each of A rows that one with which it is now (A, B, *batch); the first where there is none."""
    none = (1.0 - _fold(jnp.add, now, 1))[:, None]

    def pick(values):
        return fence(live, none * values[None, 0] + _weighted_sum(now, values, 1))

    return packed_map(pick, sides, now.ndim - 2)


def _weighted_sum(weights: Array, values: Array, axis: int) -> Array:
    """Sum over one of the two axes of constant weights (A, B, *batch) times values (A or B, F, *batch) along it.

    Its transpose is the sum over the other axis, and is given as that: JAX's own would add up one padded term
    after the other. `custom_linear_solve` is the way to state a transpose that all transformations know.
    """
    size, batch = max(weights.shape[:2]), weights.shape[2:]

    def filled(values):
        values = jnp.broadcast_to(values, values.shape[:2] + batch)
        return jnp.pad(values, [(0, size - values.shape[0]), *[(0, 0)] * (values.ndim - 1)])

    def along(axis):
        return lambda _, values: filled(_sum_of_terms(weights, values[: weights.shape[axis]], axis))

    total = lax.custom_linear_solve(lambda values: values, filled(values), along(axis), along(1 - axis))
    return total[: weights.shape[1 - axis]]


def _sum_of_terms(weights: Array, values: Array, axis: int) -> Array:
    # Term by term: XLA's own reduction of such a product takes twice the time.
    def add(total, term):
        k, value = term
        weight = lax.dynamic_index_in_dim(weights, k, axis, keepdims=False)
        return total + weight[:, None] * value[None], None

    count, zero = values.shape[0], jnp.zeros((weights.shape[1 - axis], *values.shape[1:]), values.dtype)
    return lax.scan(add, zero, (jnp.arange(count), values), unroll=min(count, 16))[0]


def _at_bodies(values: Array, colliders: tuple[int, ...], moving: int, fill: float) -> Array:
    """Values of some colliders, in ascending order, as values of all N moving bodies."""
    if min(colliders) >= moving:
        return jnp.full((moving, *values.shape[1:]), fill, values.dtype)
    if colliders == tuple(range(colliders[0], colliders[-1] + 1)):
        widths = [(colliders[0], moving - 1 - colliders[-1]), *[(0, 0)] * (values.ndim - 1)]
        return jnp.pad(values, widths, constant_values=fill)
    row = {collider: k for k, collider in enumerate(colliders)}
    padded = jnp.concatenate([values, jnp.full_like(values[:1], fill)])
    return rows(padded, tuple(row.get(body, len(colliders)) for body in range(moving)))


def _table(grid: Grid, like: Array) -> Array:
    table = constant(grid.allowed, str(like.dtype))
    return lax.expand_dims(table, range(2, 2 + like.ndim))
