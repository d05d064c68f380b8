"""Impacts of round shapes that are alone on their bodies: the usual step of a world of many discs or spheres.

The general pass evaluates every contact of every pair. Here only the *times* are found for all pairs, without
derivatives, and each body keeps its next one. The impacts of each world then go into `slots`, a few at a time, and
only these are evaluated.

A pass goes this way if it is an impact pass and, in all worlds of the batch, no body is in two contacts at the
same time, none comes to rest, none is smooth, and the slots suffice; else the general way, with the same result.
"""

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.branches import any_world
from diffrigid.collide import PairGroup
from diffrigid.contact.anchors import Anchors
from diffrigid.contact.blocks import Block, blocks_of, grouped, of_all, soonest, sum_of_met, where_allowed
from diffrigid.contact.impact import approach, closed_form, meet_on_parabola
from diffrigid.contact.impulse import comes_to_rest, restitution_at
from diffrigid.contact.materials import materials, mixed
from diffrigid.contact.sides import Side
from diffrigid.contact.slots import Slots, Table, meet, sides_of_table, slots_of, sum_of_terms, summed
from diffrigid.contact.strikes import is_rolling, relative_path_is_straight
from diffrigid.fence import unfused
from diffrigid.flight import Flight, position, velocity
from diffrigid.forces import is_constant
from diffrigid.gathers import constant, fold
from diffrigid.numerics import dot
from diffrigid.shapes import HalfSpace
from diffrigid.state import rotations

if TYPE_CHECKING:
    from diffrigid.world import World

RESTS = -1e30  # [s] marks an impact after which the bodies stay together
CROWDED = 4  # pairs per body from which this way is faster than the list of pairs
ROUNDS_PER_PASS = 3  # at most, for the impacts of a pass; most passes need one, and reverse mode pays for each


def goes_in_rounds(world: "World") -> bool:
    """Whether all bodies are discs, or spheres, whose impact times have a closed form, in many pairs. Static."""
    moving, count = len(world.names), sum(len(pairs.a) for pairs in world.pairs)
    bodies = [(kind, owner) for kind, owners in enumerate(world.owners) for owner in owners if owner < moving]

    def solved(pairs: PairGroup) -> bool:
        straight = relative_path_is_straight(world, max(pairs.a + pairs.b) < moving)
        kinds = pairs.shape_a, pairs.shape_b
        a, b = (Side(flight=None, shape=world.shapes[kind], offset=world.offsets[kind]) for kind in kinds)
        return closed_form(a, b, straight)

    one_disc_each = len({kind for kind, _ in bodies}) == 1 and sorted(o for _, o in bodies) == list(range(moving))
    quiet = is_constant(world.forces) and not world.joints and not is_rolling(world)
    return count > CROWDED * moving and quiet and one_disc_each and all(map(solved, world.pairs))


def tables_of(world: "World") -> tuple[Table, ...]:
    """Tables of all pairs of a crowded world."""
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


def isolated_impacts(world: "World", start: Anchors, launch: Any, dt: Array, sweeps: int) -> tuple[Anchors, Array]:
    """Anchors after passes of isolated impacts, and their number: `sweeps`, unless an impact is left that is none."""
    tables = tables_of(world)

    def one_pass(now: tuple) -> tuple:
        anchors, done, _ = now
        flight = lax.stop_gradient(launch(anchors.state, anchors.t0))
        following, isolated, needed = next_impacts(world, tables, flight, anchors.since, dt)

        def met(anchors: Anchors) -> Anchors:
            return meet_in_rounds(world, tables, following, needed, anchors, launch, dt)

        after = lax.cond(isolated, met, lambda anchors: anchors, anchors)
        count = jnp.where(any_world(needed > 0), done + 1, np.int32(sweeps))
        return after, jnp.where(isolated, count, done), isolated & (count < sweeps)

    def maybe(now: tuple, _: None) -> tuple:
        return lax.cond(now[2], one_pass, lambda now: now, now), None

    first = start, jnp.zeros((), np.int32), jnp.asarray(True)
    return lax.scan(maybe, first, None, length=sweeps)[0][:2]


class Next(NamedTuple):
    """The next impact of each body in this step: into which slot of its world it goes, and with what."""

    lead: Array  # (N, *batch) 1 for a body that has a slot, of two bodies the first; else 0
    rank: Array  # (N, *batch) index of that slot
    other: Array  # (N, *batch) the other collider, a body or a static


def next_impacts(world: "World", tables: tuple[Table, ...], flight: Flight, since: Array, dt: Array):
    """The next impact of each body, if any.

    Returns:
        next impacts; whether the slots suffice and all impacts are isolated, exact and with rebound, a bool; how many
        slots each world needs.
    """
    moving = len(world.names)
    tie = (jnp.sqrt(jnp.finfo(dt.dtype).eps) * dt)[None]
    many = 1 + max(max(table.b) for table in tables)

    def over_blocks(reduce: Any, each: Any, *args: Array) -> Array:
        halves = [unfused(functools.partial(each, block), t, *args) for block, t in times]
        return functools.reduce(reduce, map(of_all, halves))

    def with_what(block: Block, times: Array, first: Array) -> list[Array]:
        return sum_of_met(block, many, times, first + tie)

    def in_slots(first: Array, total: Array) -> tuple:
        other = total - many  # `many` or more if a body meets two at once
        hit = first <= dt[None]
        lead = (hit & (other > lax.broadcasted_iota(other.dtype, other.shape, 0))).astype(other.dtype)
        alone = fold(jnp.logical_and, ~hit | ((other < many) & (first > RESTS)), 0)
        return lead, jnp.where(hit, other, -1.0), ~alone

    # Not fused: times are compared with each other, and must not be computed twice with different rounding.
    times = [each for table in tables for each in _times(world, table, flight, since, dt)]
    first = over_blocks(jnp.minimum, soonest)
    lead, other, crossed = unfused(in_slots, first, over_blocks(jnp.add, with_what, first))
    before = constant(tuple(tuple(float(i < j) for j in range(moving)) for i in range(moving)), str(dt.dtype))
    rank = sum_of_terms(lax.expand_dims(before, range(2, 1 + lead.ndim)), lead[:, None], 0)[:, 0]
    needed = fold(jnp.add, lead, 0)
    crossed, width = crossed | (needed > ROUNDS_PER_PASS * slots_of(moving)), world.contact.width
    isolated = ~any_world(crossed if width is None else crossed | (width > 0))
    return Next(lead, rank, other), isolated, needed


def meet_in_rounds(
    world: "World", tables: tuple[Table, ...], following: Next, needed: Array, anchors: Anchors, launch: Any, dt: Array
) -> Anchors:
    """Anchors after the next impact of each body; rounds that no world needs are skipped."""
    count = slots_of(len(world.names))

    @jax.checkpoint
    def meet_from(begin, anchors):
        return meet(world, tables, fill_slots(tables, count, following, begin), anchors, launch, dt)

    def one_round(anchors, begin):
        return lax.cond(any_world(needed > begin), meet_from, lambda _, anchors: anchors, begin, anchors), None

    begins = constant(tuple(float(count * k) for k in range(ROUNDS_PER_PASS)), str(dt.dtype))
    return lax.scan(one_round, anchors, begins)[0]


def fill_slots(tables: tuple[Table, ...], count: int, following: Next, begin: Array) -> Slots:
    """Fill the slots of a round with the impacts from index `begin` on that are the next one for both bodies."""
    moving = len(following.rank)

    def weights(following: Next) -> Array:
        shape = (count, *following.rank.shape)
        number = begin + lax.broadcasted_iota(begin.dtype, shape, 0)
        return jnp.where(following.rank[None] == number, following.lead[None], 0.0)

    def sides(a: Array, following: Next) -> tuple[Array, Array]:
        """The first body and the other collider of each slot, (E, *batch); -1 where it is empty."""
        body = lax.broadcasted_iota(a.dtype, a.shape, 1)
        empty = summed(a) - 1.0
        return summed(a * body) + empty, summed(a * following.other[None]) + empty

    def of_b(body: Array, other: Array, following: Next) -> tuple[Array, ...]:
        def there(table: Table) -> Array:
            number = constant(table.b, str(other.dtype)).reshape(1, -1, *[1] * (other.ndim - 1))
            chosen = other[:, None] == number
            if table.b[0] < moving:
                chosen = chosen & (following.other[None] == body[:, None])
            return chosen.astype(other.dtype)

        return tuple(map(there, tables))

    a = unfused(weights, following)
    return Slots(a, unfused(of_b, *unfused(sides, a, following), following))


def _times(world: "World", table: Table, flight: Flight, since: Array, dt: Array) -> list[tuple[Block, Array]]:
    """Times of the next impacts by blocks, (G, A, B, *batch) [s]; inf: none in this step; RESTS: without rebound."""
    a, b = sides_of_table(world, table, flight, since)
    moving = len(a.flight.t0)
    if table.b[0] < moving:
        return [(block, where_allowed(table, block, t)) for block, t in _times_of_pairs(world, table, a, since, dt)]
    (block,) = blocks_of(table, moving)

    def to_statics(a: Side, b: Side, dt: Array) -> Array:
        return where_allowed(table, block, _times_to_statics(world, table, a, b, dt)[None])

    return [(block, unfused(to_statics, a, b, dt))]


def _times_of_pairs(world: "World", table: Table, bodies: Side, since: Array, dt: Array) -> list[tuple[Block, Array]]:
    """Times of the next impact of each two bodies by blocks, as `_times`: `meet_on_line`, without derivatives."""

    def at_start(flight: Flight) -> tuple[Array, Array]:
        zero = jnp.zeros_like(flight.t0)
        return jax.vmap(position)(flight, zero), jax.vmap(velocity)(flight, zero)

    def one(a: tuple, b: tuple) -> Array:
        (x_a, v_a, t_a, since_a, radius_a), (x_b, v_b, t_b, since_b, radius_b) = a, b
        P, W, R, start = x_a - x_b, v_a - v_b, radius_a + radius_b, jnp.maximum(t_a, t_b)
        W2, PW, excess = dot(W, W), dot(P, W), dot(P, P) - R * R
        D = PW * PW - W2 * excess
        root = jnp.sqrt(jnp.maximum(D, 0.0))
        closes = (D > 0) & (PW + start * W2 < 0)  # 0 for a body and itself
        s = jnp.where(closes, excess / (root - PW), jnp.inf)
        s = jnp.where(s < jnp.maximum(since_a, since_b), start, s)
        rests = (root <= world.contact.rest_speed * R) & (s <= dt)
        return jnp.where(rests, RESTS, s)

    def of_block(block: Block, lines: tuple) -> Array:
        a, b = zip(*(grouped(block, leaf) for leaf in lines), strict=True)
        return jax.vmap(jax.vmap(jax.vmap(one, (None, 0)), (0, None)))(a, b)

    lines = (*unfused(at_start, bodies.flight), bodies.flight.t0, since, bodies.shape.radius)
    return [(block, unfused(functools.partial(of_block, block), lines)) for block in blocks_of(table, len(since))]


def _times_to_statics(world: "World", table: Table, a: Side, b: Side, dt: Array) -> Array:
    """Time of the next impact of each body with each static, (N, B, *batch) [s]."""
    if isinstance(b.shape, HalfSpace):
        return _times_to_planes(world, table, a, b, dt)

    def one(a: Side, b: Side) -> Array:
        s, _, found, u = approach(a, b, None)
        return jnp.where(found, jnp.where((u <= world.contact.rest_speed) & (s <= dt), RESTS, s), jnp.inf)

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(a, b)


def _times_to_planes(world: "World", table: Table, a: Side, b: Side, dt: Array) -> Array:
    so, f = rotations(a.flight.dim), a.flight
    straight = relative_path_is_straight(world, both_move=False)
    names = ("restitution", "restitution_falloff")
    own, others = (materials(world, of, names) for of in (tuple(range(len(world.names))), table.b))

    def planes(b: Side, own: list, others: list) -> tuple:
        n = jax.vmap(so.rotate)(b.q, b.shape.normal)
        each = jax.vmap(jax.vmap(mixed, (None, 0)), (0, None))
        e, *falloff = map(each, own, others)
        return n, jax.vmap(dot)(n, b.x) + b.shape.offset, (e, *falloff)

    def one(body: tuple, plane: tuple, law: tuple) -> Array:
        (x, v, acc, t0, since, radius), (n, offset) = body, plane
        acc = None if straight else dot(n, acc)
        s, _, found, u, sunk = meet_on_parabola(dot(n, x) - offset - radius, dot(n, v), acc, None)
        s = jnp.where(sunk | (t0 + s < since), t0, t0 + s)
        closing_acc = jnp.zeros_like(u) if acc is None else -acc
        rests = comes_to_rest(u, restitution_at(u, *law) * u, closing_acc, dt - s, world.contact.rest_speed)
        return jnp.where(found, jnp.where(rests & (s <= dt), RESTS, s), jnp.inf)

    n, offset, law = unfused(planes, b, own, others)
    bodies = (f.x, f.v, f.a, f.t0, a.since, a.shape.radius)
    return jax.vmap(jax.vmap(one, (None, 0, 0)), (0, None, 0))(bodies, (n, offset), law)
