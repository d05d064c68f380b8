"""Slots: the few impacts of a pass in each world, gathered from its bodies, evaluated, and scattered back.

Bodies are gathered into slots, and scattered back, by products with one-hot weights summed over the bodies: unlike
indexing along the batch this vectorises, in both directions.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.collide import PairGroup
from diffrigid.contact.anchors import Anchors, struck
from diffrigid.contact.impulse import impulses
from diffrigid.contact.materials import law, materials
from diffrigid.contact.resting import Strikes
from diffrigid.contact.sides import Side, side_of
from diffrigid.contact.strikes import next_strikes
from diffrigid.fence import unfused
from diffrigid.flight import Flight, orientation
from diffrigid.gathers import fold, pack
from diffrigid.numerics import dot
from diffrigid.pytree import replace
from diffrigid.state import rotations

if TYPE_CHECKING:
    from diffrigid.world import World


SHARE = 8  # bodies for each slot


class Table(NamedTuple):
    """Pairs of one kind: all N bodies against each other, or against B statics."""

    pairs: PairGroup
    rows_a: tuple[int, ...]  # of world.shapes, for each body
    rows_b: tuple[int, ...]  # for each body, or each static
    b: tuple[int, ...]  # colliders: the bodies, or the statics
    allowed: tuple[tuple[float, ...], ...]  # (N, N or B): 1 if these two can meet, else 0


class Slots(NamedTuple):
    """Up to E impacts of each world, as weights 0 or 1; in each slot at most one row has weight 1."""

    a: Array  # (E, N, *batch) body a
    b: tuple[Array, ...]  # for each table (E, N or B, *batch) the other side; all 0 if the slot is not of its kind


def slots_of(moving: int) -> int:
    """Number of slots for the impacts of so many bodies."""
    return -(-moving // SHARE)


class Blow(NamedTuple):
    """The impact in each slot."""

    on: Array  # (E, *batch) 1 or 0
    strike: Strikes  # (E, ...)
    e: Array  # (E, *batch) [-]
    mu: Array  # (E, *batch) [-]


def meet(world: "World", tables: tuple[Table, ...], slots: Slots, anchors: Anchors, launch: Any, dt: Array) -> Anchors:
    """The anchors after the impacts in the slots."""
    flight, so = launch(anchors.state, anchors.t0), rotations(world.dim)
    moving, count = len(world.names), slots.a.shape[0]
    movers = [b for table, b in zip(tables, slots.b, strict=True) if table.b[0] < moving]
    weights = jnp.concatenate([slots.a, *movers])  # a of all slots, then b of all slots
    body, _ = sides_of_table(world, tables[0], flight, anchors.since)
    columns, unpack = pack((body, materials(world, tuple(range(moving)))), dt.ndim)
    columns = _pick(weights, columns)
    columns_a, columns_b = [c[:count] for c in columns], [c[count:] for c in columns]

    def blow(unpack_b: Callable, columns_a: list, columns_b: list, there: Array) -> Blow:
        (a, own), (b, others) = unpack(columns_a), unpack_b(columns_b)
        strike = jax.vmap(lambda a, b: next_strikes(world, a, b, dt))(a, b)
        strike = jax.tree.map(lambda leaf: leaf[:, 0], replace(strike, gap=None, press=None, pull=None, drift=None))
        return Blow(summed(there) * strike.active.astype(dt.dtype), strike, *law(own, others, strike))

    def end(columns: list, t: Array, P: Array, arm: Array) -> tuple:
        f = unpack(columns)[0].flight
        q = jax.vmap(orientation)(f, t)
        return jax.vmap(struck)(f, t, q, f.inverse_mass[:, None] * P, jax.vmap(so.moment)(arm, P)), t

    blows = []
    for table, there in zip(tables, slots.b, strict=True):
        if table.b[0] < moving:
            blows.append(unfused(functools.partial(blow, unpack), columns_a, columns_b, there))
        else:
            static, unpack_static = pack(_static(world, table, flight, anchors.since), dt.ndim)
            static = _pick(there, static)
            blows.append(unfused(functools.partial(blow, unpack_static), columns_a, static, there))
    on, t, P, arm_a, arm_b = unfused(_impulses, blows)
    if movers:
        on, t, P, arm = (jnp.concatenate(pair) for pair in ((on, on), (t, t), (P, -P), (arm_a, arm_b)))
    else:
        arm = arm_a
    after, unpack_after = pack(unfused(end, columns, t, P, arm), dt.ndim)
    weights = unfused(lambda weights, on: weights * on[:, None], weights, on)
    state, t = unpack_after(unfused(_put, weights, after))
    hit = fold(jnp.add, weights, 0) > 0
    old = (anchors.state, anchors.t0, anchors.since)
    state, t0, since = jax.tree.map(functools.partial(_where, hit), (state, t, t), old)
    return Anchors(state=state, t0=t0, since=since)


def _impulses(blows: list[Blow]) -> tuple:
    """Whether there is an impact in each slot, (E, *batch), its time, impulse (E, D, *batch) [N s] and both arms."""
    one, *others = blows
    for other in others:
        one = jax.tree.map(functools.partial(_where, other.on > 0), other, one)
    on, k, e, mu = one
    P = impulses(on > 0, k.K, k.normal, k.v_rel, -e * jax.vmap(dot)(k.normal, k.v_rel), mu)
    return on, k.s, P, k.arm_a, k.arm_b


def _static(world: "World", table: Table, flight: Flight, since: Array) -> tuple:
    """The statics of a table, and their materials."""
    return sides_of_table(world, table, flight, since)[1], materials(world, table.b)


def sides_of_table(world: "World", table: Table, flight: Flight, since: Array) -> tuple[Side, Side]:
    a = side_of(world, flight, since, table.pairs.shape_a, table.rows_a, tuple(range(len(table.rows_a))))
    return a, side_of(world, flight, since, table.pairs.shape_b, table.rows_b, table.b)


def _where(chosen: Array, new: Array, old: Array) -> Array:
    """Select by leading axis and batch: `chosen` (M, *batch), values (M, ..., *batch)."""
    return jnp.where(lax.expand_dims(chosen, range(1, 1 + new.ndim - chosen.ndim)), new, old)


def summed(weights: Array) -> Array:
    """Sum over the second axis: (E, A, *batch) to (E, *batch)."""
    return fold(jnp.add, weights, 1)


def _pick(weights: Array, columns: list[Array]) -> list[Array]:
    """For each of E slots, the row (of A) whose weight (E, A, *batch) is 1; row 0 if none."""

    def filled(weights, total):
        first = lax.broadcasted_iota(weights.dtype, weights.shape, 1) == 0
        return jnp.where(first, weights + (1.0 - total)[:, None], weights)

    def pick(weights, columns):
        return [_weighted_sum(weights, column, 1) for column in columns]

    weights = unfused(filled, weights, unfused(summed, weights))
    return unfused(pick, weights, columns)


def _put(weights: Array, columns: list[Array]) -> list[Array]:
    """For each of A rows, what the slots whose weight (E, A, *batch) is 1 have for it; 0 if none."""
    return [_weighted_sum(weights, column, 0) for column in columns]


def _weighted_sum(weights: Array, values: Array, axis: int) -> Array:
    """Sum over one of the two axes of constant weights (A, B, *batch) times values (A or B, F, *batch) along it.

    The transpose, the sum over the other axis, is given explicitly: JAX's own would add one padded term after the
    other. `custom_linear_solve` states a transpose in a way that all transformations know.
    """
    size, batch = max(weights.shape[:2]), weights.shape[2:]

    def filled(values):
        values = jnp.broadcast_to(values, values.shape[:2] + batch)
        return jnp.pad(values, [(0, size - values.shape[0]), *[(0, 0)] * (values.ndim - 1)])

    def along(axis):
        return lambda _, values: filled(sum_of_terms(weights, values[: weights.shape[axis]], axis))

    total = lax.custom_linear_solve(lambda values: values, filled(values), along(axis), along(1 - axis))
    return total[: weights.shape[1 - axis]]


def sum_of_terms(weights: Array, values: Array, axis: int) -> Array:
    """Sum over one of the two axes of weights (A, B, *batch) times values (A or B, F, *batch) along it.

    Term by term, which is faster than XLA's own reduction of such a product.
    """

    def add(total, term):
        k, value = term
        weight = lax.dynamic_index_in_dim(weights, k, axis, keepdims=False)
        return total + weight[:, None] * value[None], None

    count, zero = values.shape[0], jnp.zeros((weights.shape[1 - axis], *values.shape[1:]), values.dtype)
    return lax.scan(add, zero, (jnp.arange(count), values), unroll=min(count, 16))[0]
