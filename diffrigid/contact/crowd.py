"""A step for very many discs or spheres: its cost is proportional to their number, with neighbours from a grid.

The bodies of all worlds lie side by side on the last axis, which vectorises: arrays are (..., M) for M bodies. In each
round every body finds its next impact, without derivatives. Pairs that are each other's next impact collide now, as do
bodies that meet a static: their impacts are gathered, evaluated and scattered back. An impact that is next for only
one of the two waits for a later round, so that all happen in order. One that the rounds leave over is found, and
repaired, by the next step.

Resting contacts are not held here, so these worlds have no forces.
"""

import functools
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.branches import any_world
from diffrigid.contact.anchors import Anchors, struck
from diffrigid.contact.grid import Near, neighbours, pick
from diffrigid.contact.impact import approach
from diffrigid.contact.impulse import impulses
from diffrigid.contact.materials import Material, law, materials
from diffrigid.contact.sides import Side
from diffrigid.contact.slots import slots_of
from diffrigid.contact.strikes import next_strikes
from diffrigid.flight import launch, orientation, state_at
from diffrigid.gathers import rows
from diffrigid.numerics import FOUND, dot, norm, saving
from diffrigid.pytree import map_arrays, pytree, replace
from diffrigid.shapes import Disc, HalfSpace, Sphere
from diffrigid.state import State, rotations

if TYPE_CHECKING:
    from diffrigid.world import World

CROWD = 256  # bodies, the least for which this way is taken
ROUNDS_PER_SWEEP = 4  # per sweep
ROUNDING = 64  # [-] times eps times the speeds: slower closing counts as none
SLOW = 1e-3  # [-] of `rest_speed`, likewise: else sticking bodies would take all rounds


def is_many(kinds: Any, owners: Any, moving: int, alone: bool) -> bool:
    """Whether pairs are found by a grid: many bodies, all discs or all spheres; statics also half-spaces. Static.

    Args:
        kinds: type of each entry of `world.shapes`.
        owners: for each entry, the collider of each of its rows.
        alone: nothing else acts on them: no forces, joints or rolling friction, and no pairs are excluded.
    """
    entries = [entry for entry, of in enumerate(owners) for owner in of if owner < moving]
    one_each = len(entries) == moving and len(set(entries)) == 1
    return moving >= CROWD and alone and one_each and set(kinds) <= {HalfSpace, Disc, Sphere}


@pytree
class Crowd:
    """The M bodies of all worlds, side by side; values that all share have a last axis of 1."""

    world: "World"  # of one body
    shape: Any
    materials: list[Material]
    dt: Array  # (M,) [s]


@pytree
class Walls:
    """R statics of one kind, (R, ..., M)."""

    side: Side
    materials: list[Material]
    number: Array  # (R,) int, from M on


class Encounters(NamedTuple):
    """Impacts of a round: up to E bodies, and what each meets."""

    a: Array  # (E,) int
    b: Array  # (E,) int: a body, or from M on a static
    there: Array  # (E,) bool


def step_crowd(world: "World", state: State, dt: Array) -> State:
    """State of a crowd after dt (*batch) [s]."""
    crowd, start = _side_by_side(world, dt), _states(state, dt.shape)
    t0 = jnp.zeros_like(start.x[:, 0])
    anchors = Anchors(state=start, t0=t0, since=t0 - crowd.dt[None])
    last = _impacts(crowd, _walls(world, dt.shape), _near(world, crowd, start), anchors)
    end = state_at(launch(crowd.world, last.state, None, last.t0, crowd.dt), crowd.dt)

    def back(leaf: Array) -> Array:
        inner = leaf.shape[1:-1]
        return jnp.moveaxis(leaf[0].reshape(*inner, len(world.names), *dt.shape), len(inner), 0)

    return jax.tree.map(back, end)


def without_room(world: "World", state: State, dt: Array) -> Array:
    """Number of neighbours, summed over the bodies of one crowd, without room in a step of dt () [s]; ()."""
    near = _near(world, _side_by_side(world, dt), _states(state, ()))
    return jnp.maximum(near.found - len(near.other), 0).sum()


# ---- the bodies of all worlds side by side


def _columns(leaf: Array, bodies: bool, count: int, batch: tuple[int, ...]) -> Array:
    """Reshape an array of `bodies` (N, ..., *batch) to (..., M); others (..., *batch) too, or to (..., 1) if shared."""
    inner, own = leaf.shape[: leaf.ndim - len(batch)], leaf.shape[leaf.ndim - len(batch) :]
    if not bodies:
        if max(own, default=1) == 1:
            return leaf.reshape(*inner, 1)
        leaf, inner = jnp.broadcast_to(leaf[None], (count, *leaf.shape)), (count, *inner)
    leaf = jnp.moveaxis(jnp.broadcast_to(leaf, inner + batch), 0, len(inner) - 1)
    return leaf.reshape(*inner[1:], -1)


def _states(state: State, batch: tuple[int, ...]) -> State:
    """Reshape states to (1, ..., M): one body, and the bodies of all worlds as its batch."""
    return map_arrays(lambda leaf, *_: _columns(leaf, True, len(leaf), batch)[None], state)


def _side_by_side(world: "World", dt: Array) -> Crowd:
    count, batch = len(world.names), dt.shape

    def of_bodies(leaf: Array, *_: Any) -> Array:
        return _columns(leaf, True, count, batch)

    def of_all(leaf: Array, *_: Any) -> Array:
        return _columns(leaf, False, count, batch)

    kind = next(k for k, owners in enumerate(world.owners) if min(owners) < count)
    row_of = {owner: row for row, owner in enumerate(world.owners[kind])}
    shape = jax.tree.map(lambda leaf: rows(leaf, tuple(row_of[i] for i in range(count))), world.shapes[kind])
    one = replace(
        world, bodies=map_arrays(lambda *leaf: of_bodies(*leaf)[None], world.bodies), names=("body",), statics=None,
        contact=map_arrays(of_all, world.contact), shapes=(), offsets=(),
    )  # fmt: skip
    own = jax.tree.map(of_bodies, materials(world, tuple(range(count))))
    return Crowd(world=one, shape=jax.tree.map(of_bodies, shape), materials=own, dt=of_all(dt))


def _walls(world: "World", batch: tuple[int, ...]) -> list[Walls]:
    """All statics, by kind."""
    count, walls = len(world.names), []

    def each(leaf: Array) -> Array:
        return jnp.stack([_columns(row, False, count, batch) for row in leaf])

    for kind, owners in enumerate(world.owners):
        still = [(row, owner) for row, owner in enumerate(owners) if owner >= count]
        if still:
            row, owner = zip(*still, strict=True)
            shape = jax.tree.map(lambda leaf, row=row: rows(leaf, row), world.shapes[kind])
            x, q = (rows(leaf, tuple(i - count for i in owner)) for leaf in (world.statics.x, world.statics.q))
            side, own = jax.tree.map(each, (Side(flight=None, shape=shape, x=x, q=q), materials(world, owner)))
            size = count * math.prod(batch)
            walls.append(
                Walls(side=side, materials=own, number=jnp.array([size + i - count for i in owner], jnp.int32))
            )
    return walls


def _near(world: "World", crowd: Crowd, start: State) -> Near:
    """Neighbours that each body can touch within the step, at the speeds of its start."""
    fastest = norm(start.v[0]).max()
    x, reach = start.x[0], crowd.shape.radius + fastest * crowd.dt
    return neighbours(x, jnp.broadcast_to(reach, x.shape[1:]), x.shape[1] // len(world.names), world.contact.neighbours)


# ---- rounds


def _impacts(crowd: Crowd, walls: list[Walls], near: Near, start: Anchors) -> Anchors:
    """Anchors after all rounds; rounds that no world needs are skipped."""

    # For reverse mode a round is cheaper to recompute than to save, except for its search (FOUND).
    @saving(FOUND)
    def one_round(anchors: Anchors) -> tuple[Anchors, Array]:
        flight = jax.tree.map(lambda leaf: leaf[0], launch(crowd.world, anchors.state, None, anchors.t0, crowd.dt))
        bodies = Side(flight=flight, since=anchors.since[0], shape=crowd.shape)
        following = checkpoint_name(_next(crowd, walls, near, lax.stop_gradient(bodies)), FOUND)
        any_there = any_world(following.there)
        after = lax.cond(any_there, lambda a: _meet(crowd, walls, following, bodies, a), lambda a: a, anchors)
        return after, any_there

    def maybe(carry: tuple[Anchors, Array], _: None) -> tuple[tuple[Anchors, Array], None]:
        return lax.cond(carry[1], lambda anchors, _: one_round(anchors), lambda *carry: carry, *carry), None

    return lax.scan(maybe, (start, jnp.asarray(True)), length=ROUNDS_PER_SWEEP * crowd.world.contact.sweeps)[0][0]


def _next(crowd: Crowd, walls: list[Walls], near: Near, bodies: Side) -> Encounters:
    """Impacts that are the next one for both their bodies, as many as there are slots."""
    count, dt = len(near.found), lax.stop_gradient(crowd.dt)
    speed, eps, rest_speed = norm(bodies.flight.v), jnp.finfo(dt.dtype).eps, crowd.world.contact.rest_speed
    rest_speed, tie = lax.stop_gradient(rest_speed), jnp.sqrt(eps) * dt
    me = lax.broadcasted_iota(jnp.int32, (count,), 0)

    def sooner(best: tuple, b: Side, number: Array, there: Any, speeds: Array) -> tuple:
        first, fastest, other = best
        s, _, found, u = approach(bodies, b, None)
        closes = u > jnp.maximum(ROUNDING * eps * speeds, SLOW * rest_speed)
        s = jnp.where(there & found & (s <= dt) & closes, jnp.floor(s / tie), jnp.inf)
        # At equal times the fastest first, then the lower index: alike for both sides, so that some pair agrees.
        before = (u > fastest) | ((u == fastest) & (number < other))
        better = (s < first) | ((s == first) & (s < jnp.inf) & before)
        return tuple(jnp.where(better, new, old) for new, old in zip((s, u, number), best, strict=True))

    def body(k: Array, best: tuple) -> tuple:
        number = lax.dynamic_index_in_dim(near.other, k, 0, keepdims=False)
        j = jnp.maximum(number, 0)
        return sooner(best, _at(bodies, j), number, number >= 0, speed + pick(speed, j))

    def wall(best: tuple, one: Walls) -> tuple[tuple, None]:
        return sooner(best, one.side, one.number, True, speed), None

    most = jnp.minimum(near.found.max(), len(near.other))
    best = jnp.full_like(speed, jnp.inf), jnp.zeros_like(speed), jnp.zeros_like(me)
    best = lax.fori_loop(0, most, body, best)
    for kind in walls:
        best, _ = lax.scan(wall, best, lax.stop_gradient(kind))
    first, _, other = best
    back = pick(other, jnp.minimum(other, count - 1))
    lead = (first < jnp.inf) & ((other >= count) | ((back == me) & (me < other)))
    ranks = jnp.cumsum(lead.astype(jnp.int32))
    slot = lax.broadcasted_iota(jnp.int32, (slots_of(count),), 0)
    a = jnp.minimum(jnp.searchsorted(ranks, slot + 1).astype(jnp.int32), count - 1)
    return Encounters(a, pick(other, a), slot < ranks[-1])


def _meet(crowd: Crowd, walls: list[Walls], following: Encounters, bodies: Side, anchors: Anchors) -> Anchors:
    """Anchors after the impacts of a round."""
    (a, b, there), count = following, anchors.t0.shape[1]
    moves = there & (b < count)
    b = jnp.where(moves, b, (a + 1) % count)  # some other body, where it is a wall
    side_a, side_b = _at(bodies, a), _at(bodies, b)
    own, others = _at(crowd.materials, a), _at(crowd.materials, b)
    blow = _blow(crowd, a, side_a, own, side_b, others, moves)
    for kind in walls:
        meets = kind.number[:, None] == following.b[None]
        hit = there & meets.any(0)
        side, others = _of_rows((kind.side, kind.materials), jnp.argmax(meets, 0), a)
        blow = jax.tree.map(functools.partial(jnp.where, hit), _blow(crowd, a, side_a, own, side, others, hit), blow)
    on, t, P, arm_a, arm_b = blow

    def after(side: Side, P: Array, arm: Array) -> State:
        f = side.flight
        dL = rotations(f.dim).moment(arm, P)
        return struck(f, t, orientation(f, t), f.inverse_mass[None] * P, dL)

    ends = jax.tree.map(lambda *two: jnp.concatenate(two, -1), after(side_a, P, arm_a), after(side_b, -P, arm_b))
    empty = count + lax.broadcasted_iota(jnp.int32, (2 * len(a),), 0)  # beyond the last: left out
    index = jnp.where(jnp.concatenate([on, on & moves]), jnp.concatenate([a, b]), empty)

    def put(leaf: Array, value: Array) -> Array:
        return leaf.at[..., index].set(value[None], mode="drop", unique_indices=True)

    t = jnp.concatenate([t, t])
    state = jax.tree.map(put, anchors.state, ends)
    return Anchors(state=state, t0=put(anchors.t0, t), since=put(anchors.since, t))


def _blow(crowd: Crowd, a: Array, side_a: Side, own: list, side_b: Side, others: list, there: Array) -> tuple:
    """Whether there is an impact, its time [s], impulse on a (D, E) [N s], and arms (D, E) [m]."""
    world, dt = _at((crowd.world, crowd.dt), a)
    strike = next_strikes(world, side_a, side_b, jnp.broadcast_to(dt, a.shape))
    on = strike.active & there[None]
    own, others = jax.tree.map(lambda leaf: leaf[None], (own, others))
    e, mu = law(own, others, strike)
    u = -jax.vmap(dot)(strike.normal, strike.v_rel)
    target = jnp.where(u <= world.contact.rest_speed[None], 0.0, e * u)
    P = impulses(on, strike.K, strike.normal, strike.v_rel, target, mu)
    return on[0], strike.s[0], P[0], strike.arm_a[0], strike.arm_b[0]


def _at(tree: Any, index: Array) -> Any:
    """Gather the bodies `index` (E,) of M; axes of length 1 stay."""
    return jax.tree.map(lambda leaf: pick(leaf, index) if leaf.shape[-1] > 1 else leaf, tree)


def _of_rows(tree: Any, row: Array, body: Array) -> Any:
    """Gather from statics (R, ..., M or 1) the `row` of each `body`, (..., E)."""

    def chosen(leaf: Array) -> Array:
        many = leaf.shape[-1]
        flat = jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], -1)
        return pick(flat, row * many + (body if many > 1 else 0))

    return jax.tree.map(chosen, tree)
