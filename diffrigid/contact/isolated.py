"""Impacts of round shapes that are alone on their bodies: the usual step of a world of many discs or spheres.

The general pass evaluates every contact of every pair. Here only the *times* are found for all pairs, without
derivative, and each body keeps its next one. The next few impacts of each world then go into `slots`, and only
these are evaluated.

A pass goes this way if it is an impact pass and, in all worlds of the batch, no body is in two contacts at the
same time, none comes to rest, and the slots suffice; else the general way, to the same result.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.collide import PairGroup
from diffrigid.contact.impact import approach, closed_form, meet_on_parabola
from diffrigid.contact.impulse import restitution_at
from diffrigid.contact.sides import Side
from diffrigid.contact.slots import Slots, Table, fold, sides_of_table, summed
from diffrigid.contact.strikes import is_rolling, materials, mixed, relative_path_is_straight
from diffrigid.flight import Flight, position, velocity
from diffrigid.forces import is_constant
from diffrigid.numerics import apart, constant, dot, safe_sqrt
from diffrigid.shapes import HalfSpace
from diffrigid.state import rotations

RESTS = -1e30  # [s] stands for an impact after which bodies stay together
CROWDED = 4  # pairs per body from which this way is faster than the list of pairs
SHARE = 4  # bodies for each slot


def is_crowded(world: Any) -> bool:
    """Whether all bodies are discs, or spheres, whose impact times have a closed form, in many pairs. Static."""
    moving, count = len(world.names), sum(len(pairs.a) for pairs in world.pairs)
    bodies = [(kind, owner) for kind, owners in enumerate(world.owners) for owner in owners if owner < moving]

    def solved(pairs: PairGroup) -> bool:
        straight = relative_path_is_straight(world, max(pairs.a + pairs.b) < moving)
        return closed_form(world.shapes[pairs.shape_a], world.shapes[pairs.shape_b], straight)

    one_disc_each = len({kind for kind, _ in bodies}) == 1 and sorted(o for _, o in bodies) == list(range(moving))
    quiet = is_constant(world.forces) and not world.joints and not is_rolling(world)
    return count > CROWDED * moving and quiet and one_disc_each and all(map(solved, world.pairs))


def tables_of(world: Any) -> tuple[Table, ...]:
    """The tables that hold all pairs of a crowded world."""
    moving = len(world.names)

    def table(pairs: PairGroup) -> Table:
        row_of = {owner: row for row, owner in enumerate(world.owners[pairs.shape_a])}
        row_of_b = {owner: row for row, owner in enumerate(world.owners[pairs.shape_b])}
        bodies = tuple(range(moving))
        b = bodies if max(pairs.b) < moving else tuple(sorted(set(pairs.b)))
        there = set(zip(pairs.a, pairs.b, strict=True)) | set(zip(pairs.b, pairs.a, strict=True))
        allowed = tuple(tuple(float((i, j) in there) for j in b) for i in bodies)
        return Table(pairs, tuple(row_of[i] for i in bodies), tuple(row_of_b[j] for j in b), b, allowed)

    return tuple(map(table, world.pairs))


def next_impacts(world: Any, tables: tuple[Table, ...], flight: Flight, since: Array, dt: Array):
    """The impacts of this step that are the next one of both bodies.

    Returns:
        slots; whether they hold all of these impacts and all are isolated, exact and do not rest, a bool; whether
        there are any, a bool.
    """
    moving, live = len(world.names), jnp.any(dt > 0)
    tie = (jnp.sqrt(jnp.finfo(dt.dtype).eps) * dt)[None]

    def of_bodies(soonest):
        first = later = jnp.full_like(soonest[0][0], jnp.inf)
        for least, following, _ in soonest:
            later = jnp.minimum(jnp.maximum(first, least), jnp.minimum(later, following))
            first = jnp.minimum(first, least)
        first = jnp.where(first <= dt[None], first, jnp.inf)
        return first, jnp.all((first == jnp.inf) | ((later > first + tie) & (first > RESTS)))

    # Apart: times are compared with each other below, and must not be computed twice with another rounding.
    soonest = [_soonest(live, world, table, flight, since, dt) for table in tables]
    first, alone = apart(live, of_bodies, soonest)
    s = apart(live, functools.partial(_in_order, count=-(-moving // SHARE)), first)
    slots, ties = _slots(live, moving, tables, soonest, first, s, tie)
    too_many = jnp.any((first > s[-1][None]) & (first < jnp.inf))
    isolated = alone & ~too_many & ~ties & ~jnp.any(world.contact.width > 0)
    return slots, isolated, jnp.any(s[0] < jnp.inf)


def _soonest(live: Array, world: Any, table: Table, flight: Flight, since: Array, dt: Array) -> tuple:
    """Times of the next impacts with one side of a table [s]; inf: none in this step; RESTS: without rebound.

    Returns:
        (N, *batch) of each body the first and, against statics, the second; (B, *batch) of each static the first.
    """
    a, b = sides_of_table(world, table, flight, since)
    if table.b[0] < a.flight.t0.shape[0]:
        times = apart(live, functools.partial(_times_of_pairs, world, table), a, since, dt)
        least = apart(live, functools.partial(fold, jnp.minimum, axis=1), times)
        return least, jnp.full_like(least, jnp.inf), None
    times = apart(live, functools.partial(_times_to_statics, world, table), a, b, dt)
    return *apart(live, _two_smallest, times), apart(live, functools.partial(fold, jnp.minimum, axis=0), times)


def _times_of_pairs(world: Any, table: Table, bodies: Side, since: Array, dt: Array) -> Array:
    """Time of the next impact of each body with each other, (N, N, *batch) [s]: `meet_on_line`, without derivative."""
    zero = jnp.zeros_like(bodies.flight.t0)
    x, v = jax.vmap(position)(bodies.flight, zero), jax.vmap(velocity)(bodies.flight, zero)

    def one(a: tuple, b: tuple) -> Array:
        (x_a, v_a, t_a, since_a, radius_a), (x_b, v_b, t_b, since_b, radius_b) = a, b
        P, W, R, start = x_a - x_b, v_a - v_b, radius_a + radius_b, jnp.maximum(t_a, t_b)
        W2, PW, excess = dot(W, W), dot(P, W), dot(P, P) - R * R
        D = PW * PW - W2 * excess
        root = safe_sqrt(D)
        closing = (D > 0) & (PW + start * W2 < 0)  # 0 for a body and itself
        s = jnp.where(closing, excess / (root - PW), jnp.inf)
        s = jnp.where(s < jnp.maximum(since_a, since_b), start, s)
        rests = (root <= world.contact.rest_speed * R) & (s <= dt)
        return jnp.where(rests, RESTS, s)

    lines = (x, v, bodies.flight.t0, since, bodies.shape.radius)
    return _allowed(table, jax.vmap(jax.vmap(one, (None, 0)), (0, None))(lines, lines))


def _times_to_statics(world: Any, table: Table, a: Side, b: Side, dt: Array) -> Array:
    """Time of the next impact of each body with each static, (N, B, *batch) [s]."""
    if isinstance(b.shape, HalfSpace):
        times = _times_to_planes(world, table, a, b, dt)
    else:

        def one(a: Side, b: Side) -> Array:
            s, _, found, u = approach(a, b, dt, None, True)
            return jnp.where(found, jnp.where((u <= world.contact.rest_speed) & (s <= dt), RESTS, s), jnp.inf)

        times = jax.vmap(jax.vmap(one, (None, 0)), (0, None))(a, b)
    return _allowed(table, times)


def _times_to_planes(world: Any, table: Table, a: Side, b: Side, dt: Array) -> Array:
    so, live, f = rotations(a.flight.dim), jnp.any(dt > 0), a.flight
    names = ("restitution", "restitution_falloff")
    own, others = (materials(world, of, names) for of in (tuple(range(len(world.names))), table.b))

    def planes(b: Side, own: list, others: list) -> tuple:
        n = jax.vmap(so.rotate)(b.q, b.shape.normal)
        each = jax.vmap(jax.vmap(mixed, (None, 0)), (0, None))
        e, *falloff = map(each, own, others)
        return n, jax.vmap(dot)(n, b.x) + b.shape.offset, (2.0 * e, *falloff)

    def one(body: tuple, plane: tuple, twice_e: tuple) -> Array:
        (x, v, acc, t0, since, radius), (n, offset) = body, plane
        acc = dot(n, acc)
        s, _, found, u, sunk = meet_on_parabola(dot(n, x) - offset - radius, dot(n, v), acc, None)
        s = jnp.where(sunk | (t0 + s < since), t0, t0 + s)
        rests = (u <= world.contact.rest_speed) | (restitution_at(u, *twice_e) * u <= -acc * (dt - s))
        return jnp.where(found, jnp.where(rests & (s <= dt), RESTS, s), jnp.inf)

    n, offset, twice_e = apart(live, planes, b, own, others)
    bodies = (f.x, f.v, f.a, f.t0, a.since, a.shape.radius)
    return jax.vmap(jax.vmap(one, (None, 0, 0)), (0, None, 0))(bodies, (n, offset), twice_e)


def _allowed(table: Table, times: Array) -> Array:
    """The times (N, B, *batch), inf where the two cannot meet."""
    pairs = ((i, j, allowed) for i, row in enumerate(table.allowed) for j, allowed in zip(table.b, row, strict=True))
    if all(allowed or i == j for i, j, allowed in pairs):
        return times
    allowed = constant(table.allowed, str(times.dtype))
    return jnp.where(lax.expand_dims(allowed, range(2, times.ndim)) > 0, times, jnp.inf)


def _slots(live: Array, moving: int, tables: tuple, soonest: list, first: Array, s: Array, tie: Array):
    """The impacts at the times s (E, *batch), as slots, and whether two share a body or cannot be told apart."""

    def taking_part(soonest, first, s):
        """(E, N, *batch) for each table: 1 for bodies whose next impact is then and of this kind; how many."""
        now = (first[None] == s[:, None]) & (s < jnp.inf)[:, None]
        return [(now & (least[None] == s[:, None])).astype(s.dtype) for least, *_ in soonest]

    bodies = apart(live, taking_part, soonest, first, s)
    counts = apart(live, lambda bodies: [summed(now) for now in bodies], bodies)
    total, void = sum(counts), jnp.zeros_like(s, bool)
    fine = total == 0
    for table, n in zip(tables, counts, strict=True):
        both = table.b[0] < moving
        void = void | (n == 1) if both else void
        fine = fine | ((n == total) & ((n <= 2) if both else (n == 1)))
    near = (s[1:] - s[:-1] <= tie) & (void[1:] | void[:-1])  # inf - inf is not

    def lowest(now, n):
        number = lax.broadcasted_iota(s.dtype, now.shape, 1)
        return jnp.where(n == 2, fold(jnp.minimum, jnp.where(now > 0, number, moving), 1), moving)

    def weights(soonest, bodies, counts, lowest, s):
        of_a, of_b = 0.0, []
        for table, now, n, k, (_, _, column) in zip(tables, bodies, counts, lowest, soonest, strict=True):
            if table.b[0] < moving:
                a = (lax.broadcasted_iota(s.dtype, now.shape, 1) == k[:, None]).astype(s.dtype)
                of_b.append(jnp.where((n == 2)[:, None], now - a, 0.0))
            else:
                a = now
                of_b.append((column[None] == s[:, None]).astype(s.dtype) * n[:, None])
            of_a = of_a + a
        return Slots(of_a, tuple(of_b))

    firsts = [
        apart(live, lowest, now, n) if table.b[0] < moving else None
        for table, now, n in zip(tables, bodies, counts, strict=True)
    ]
    return apart(live, weights, soonest, bodies, counts, firsts, s), ~jnp.all(fine) | jnp.any(near)


def _in_order(first: Array, count: int) -> Array:
    """The `count` least different values of (N, *batch) over the bodies, ascending; inf where there are fewer."""

    def following(s, _):
        s = fold(jnp.minimum, jnp.where(first > s[None], first, jnp.inf), 0)
        return s, s

    return lax.scan(following, jnp.full_like(first[0], -jnp.inf), None, length=count)[1]


def _two_smallest(table: Array) -> tuple[Array, Array]:
    """The smallest and the next of each row of a table (A, B, *batch)."""
    least, following = table[:, 0], jnp.full_like(table[:, 0], jnp.inf)
    for k in range(1, table.shape[1]):
        least, following = jnp.minimum(least, table[:, k]), jnp.minimum(following, jnp.maximum(least, table[:, k]))
    return least, following
