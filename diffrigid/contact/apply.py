"""From the contacts of a pass to the bodies after it: solve for impulses, move the bodies, and re-anchor them.

A resting contact force is constant over the time T since the last impact of the body. Its impulse P changes v by P / m
and x by (T / 2) P / m: its centroid is in the middle of that time, and so are its lever arms (`levers.py`). For a block
that slides on a floor with Coulomb friction this is exact; for one that tips over, of second order.
"""

from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.branches import choose
from diffrigid.contact.anchors import Anchors, struck
from diffrigid.contact.known import Known, beside, loads, reversing, weighed
from diffrigid.contact.mobility import (
    Mobility,
    answers_of_forces,
    jointed,
    mids,
    momentum_changes,
    relative_changes,
    velocities,
)
from diffrigid.contact.order import Links, companions, over_islands
from diffrigid.contact.resting import Law, Strikes, are_alone, barely, solve_impulses
from diffrigid.contact.rolling import beside_rolling, rolling_reversing, rolling_stops, with_rows
from diffrigid.contact.slipping import drift_after, keeping_spin, stopping_early
from diffrigid.contact.strikes import is_rolling
from diffrigid.contact.sums import at_colliders, side_sum
from diffrigid.fence import at_hand
from diffrigid.flight import Flight, angular_momentum, orientation, position, velocity
from diffrigid.gathers import flags
from diffrigid.linkage import Linkage, ends_of, linkage, spread
from diffrigid.numerics import norm, safe_divide, safe_sqrt
from diffrigid.pytree import replace
from diffrigid.state import State, rotations

if TYPE_CHECKING:
    from diffrigid.world import World

LEAST_TURN = 1e-6  # [rad] that is limited: turns of bodies that do not spin are rounding, with right derivatives


def apply_impulses(
    world: "World",
    anchors: Anchors,
    flight: Flight,
    strikes: Strikes,
    law: Law,
    kick: Array,
    held_for: Array,
    known: Known | None,
    weighs: Array,
) -> tuple[Anchors, Known | None, Array | None]:
    """Solve for the impulses and re-anchor every struck body at the time of its impact.

    Re-anchoring at s makes P displace the body by (h - s) P / m until the end h of the step, and composes the rotations
    before and after s.

    Args:
        kick: 1, or 0 for a displacement that leaves velocities as they are.
        held_for: (C, *batch) [s] time over which the impulse of a resting contact has acted, else 0.
        weighs: bool: without friction where it may reverse, to find out what it does, see `known.weighed`.

    Returns:
        the anchors; with `known`, the impulses of friction that reverses, and the corrections that undo the loads.
    """
    moving, active, held = flight.t0.shape[0], strikes.active.astype(kick.dtype), strikes.held.astype(kick.dtype)
    each = jnp.stack([active, active * strikes.s, held], axis=1)
    own = side_sum(each, each, strikes.a, strikes.b, moving)
    together = companions(world)
    count, total, evenly = jnp.moveaxis(over_islands(jnp.sum, own, together, 0.0), 1, 0)
    t = jnp.where(count > 0, total / jnp.maximum(count, 1.0), flight.t0)
    holds = (kick > 0) & (evenly > 0)
    q, mobility, link = _posed(world, flight, t, jnp.where(holds, 0.5 * (t - flight.t0), 0.0))
    onto = None if link is None else _onto_joints(flight, t, link, (count > 0) & (kick > 0))
    if onto is not None:
        strikes = replace(strikes, v_rel=strikes.v_rel + relative_changes(strikes, *onto[:2]))
    at, unsolved = (flight, t, mobility), (strikes, law)
    strikes, law, held_for, P, early_P = _solved(world, at, strikes, law, kick, held_for, known, own[:, 0])
    load = None if known is None else loads(strikes, P, law.most, held_for)
    if known is not None:
        P, early_P = P + known.P, early_P + known.early
    dv, dw, dL = velocities(mobility, *momentum_changes(strikes, P, moving))
    friction = None
    if known is not None:
        began = None if known.trial is None else partial(_began, flight, strikes)
        in_trial = rolling_reversing if is_rolling(world) else partial(reversing, began=began)
        friction = in_trial(mobility, strikes, P, (dv, dw), law, held_for, world.contact.rest_speed)
        if known.trial is not None:
            friction = choose(weighs, weighed(mobility, unsolved[0], P, known, unsolved[1], held_for), friction)
    # A force that has acted evenly has its centroid in the middle of its time, for which it displaces by P / m.
    displacing = jnp.where(kick > 0, 0.5 * held_for, 1.0)[:, None] * P + early_P
    moved = velocities(mobility, *momentum_changes(strikes, displacing, moving))[:2]
    moved = _no_further_than_flown(flight, t, mobility, strikes, (dv, dw), moved, kick)
    if not are_alone(strikes.a, strikes.b, moving):
        moved = tuple(map(jnp.add, moved, _at_their_times(strikes, P, t, mobility, kick)))
    pushed = keeping_spin(strikes, strikes.drift, (1.0 - kick) * P, moving)
    kept = _no_faster_than_drift(mobility, pushed, strikes) + keeping_spin(
        strikes, drift_after(strikes, dv), early_P, moving
    )
    kicked = kick * dv, kick * dL + kept
    if onto is not None:
        kicked = kicked[0] + onto[0], kicked[1] + onto[2]
    # The new path of a body that was held, followed backwards, agrees with its true path to second order.
    since = jnp.where(count > 0, jnp.where(holds, flight.t0, t), anchors.since)
    return _anchored(flight, t, q, since, kicked, moved), friction, load


def _began(flight: Flight, strikes: Strikes) -> Array:
    """Relative velocities at all contacts where the paths of their bodies begin, (C, D, *batch) [m/s]."""
    so = rotations(flight.dim)

    def twist(f: Flight) -> tuple[Array, Array]:
        q, L = orientation(f, f.t0), angular_momentum(f, f.t0)
        return velocity(f, f.t0), so.apply(so.world_inverse(f.inverse_inertia, q), L)

    arm_a, arm_b = (2.0 * mid - end for mid, end in zip(mids(strikes), (strikes.arm_a, strikes.arm_b), strict=True))
    return relative_changes(replace(strikes, arm_a=arm_a, arm_b=arm_b), *jax.vmap(twist)(flight))


def _at_their_times(strikes: Strikes, P: Array, t: Array, mobility: Mobility, kick: Array) -> tuple[Array, Array]:
    """Displacements and turns (N, ., *batch) by impacts P at their own times instead of t, the mean for each body.

    The times are equal but for rounding. Their derivatives are not: two walls that are struck at once need not be.
    """
    P = jnp.where(strikes.held, 0.0, kick)[:, None] * P
    late = -strikes.s[:, None] * P
    (dv, dw), (dx, turn) = (velocities(mobility, *momentum_changes(strikes, each, len(t)))[:2] for each in (P, late))
    return t[:, None] * dv + dx, t[:, None] * dw + turn


def _no_further_than_flown(
    flight: Flight, t: Array, mobility: Mobility, strikes: Strikes, by: tuple[Array, Array],
    moved: tuple[Array, Array], kick: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Limit displacements (N, D, *batch) and turns (N, A, *batch) to the time times the speeds before and after.

    Displacements: the speeds relative to the fastest that it touches, or else the change of its velocity. They are half
    as large where all forces of a body have acted for one time. Where some have begun later, a light body between heavy
    ones, on which these forces all but cancel, would be thrown off. A body with joints turns with its linkage: its
    turn is limited as its displacement is, by its own speeds.

    Args:
        by: changes of v [m/s] and w [rad/s].
    """
    L = jax.vmap(angular_momentum)(flight, t)
    v, w = jax.vmap(velocity)(flight, t), jax.vmap(rotations(flight.dim).apply)(mobility.inverse_inertia, L)
    v, w = (v, v + by[0]), (w, w + by[1])
    joined = flags(tuple(i in mobility.joined for i in range(len(t))), t)
    flown, turned = (sum(map(jax.vmap(norm), speeds)) for speeds in (v, w))
    apart = jnp.maximum(sum(_speeds_apart(strikes, speeds) for speeds in v), jax.vmap(norm)(by[0]))

    def share(speed: Array, way: Array, least: float) -> Array:
        most, size = (t - flight.t0) * speed, jax.vmap(norm)(way)
        return jnp.where((kick > 0) & (size > most + least), safe_divide(most, size), 1.0)[:, None]

    of_way, of_turn = share(jnp.where(joined, flown, apart), moved[0], 0.0), share(turned, moved[1], LEAST_TURN)
    return of_way * moved[0], jnp.where(joined[:, None], of_way, of_turn) * moved[1]


def _speeds_apart(strikes: Strikes, v: Array) -> Array:
    """Largest speed of each body relative to one that it touches, (N, *batch) [m/s], from velocities (N, D, *batch)."""
    of_a, of_b = (at_colliders(v, side, 0.0) for side in (strikes.a, strikes.b))
    speed = jnp.where(strikes.active, jax.vmap(norm)(of_a - of_b), 0.0)
    return Links(strikes.a, strikes.b, tuple((i,) for i in range(len(v)))).of_bodies(jnp.max, speed, 0.0)


def _no_faster_than_drift(mobility: Mobility, dL: Array, strikes: Strikes) -> Array:
    """Limit dL (N, A, *batch) to rotations no faster than bodies drift apart; zero where some contact is deep.

    Bodies that are so deep inside each other that no displacement suffices would press without bound, and gain energy.
    """
    dw = jax.vmap(rotations(strikes.drift.shape[1]).apply)(mobility.inverse_inertia, dL)
    rim = safe_sqrt((mobility.inverse_mass * (dL * dw).sum(1)).max(0))  # speed of the same energy as the rotation
    deep = (strikes.active & (strikes.gap < -strikes.deepest)).any(0)
    most = jnp.where(deep, 0.0, 2.0 * jax.vmap(norm)(strikes.drift).max(0))
    return jnp.where(rim > most, safe_divide(most, rim), 1.0)[None, None] * dL


def _solved(
    world: "World", at: tuple[Flight, Array, Mobility], strikes: Strikes, law: Law, kick: Array, held_for: Array,
    known: Known | None, count: Array,
) -> tuple[Strikes, Law, Array, Array, Array]:  # fmt: skip
    """Strikes, law and times with the rolling rows, the unknown impulses, and their corrections for early stops."""
    (flight, t, mobility), stopped = at, stopping_early
    if is_rolling(world):
        strikes, law, held_for = with_rows(world, strikes, law, held_for, flight, t, mobility, kick)
        acting = strikes.active.astype(kick.dtype)
        count = side_sum(acting, acting, strikes.a, strikes.b, flight.t0.shape[0])
        stopped = rolling_stops
    if known is not None and is_rolling(world):
        strikes, law = beside_rolling(mobility, strikes, law, known, held_for)
    elif known is not None:
        strikes, law = beside(mobility, strikes, law, known)
    rest_speed = world.contact.rest_speed
    guess = barely(strikes, rest_speed)
    if known is not None:  # resting contacts have almost no gaps, so what displaces them back is what undid their loads
        guess = jnp.where(kick > 0, guess, -known.P)
    P = solve_impulses(strikes, law, mobility, count, rest_speed, lax.stop_gradient(guess), held_for)
    return strikes, law, held_for, P, stopped(mobility, strikes, P, law, held_for, rest_speed)


def _onto_joints(flight: Flight, t: Array, link: Linkage, hit: Array) -> tuple[Array, Array, Array]:
    """Changes of v, w and L that project the velocities of `hit` bodies (N, *batch) onto their joints.

    Flight violates the joints by its integration error. Contacts cannot correct that: two sticking contacts on two
    bodies of one linkage would press without bound.
    """
    apply, on = rotations(flight.dim).apply, hit[:, None].astype(t.dtype)
    v, L = jax.vmap(velocity)(flight, t), jax.vmap(angular_momentum)(flight, t)
    return spread(link, on * v, on * jax.vmap(apply)(link.inverse_inertia, L))


def _posed(world: "World", flight: Flight, t: Array, ago: Array) -> tuple[Array, Mobility, Linkage | None]:
    """Orientations of all bodies, each at its own time t (N, *batch), their mobility there, and their joints.

    Args:
        ago: (N, *batch) [s] how long before t impulses act.
    """
    so = rotations(flight.dim)

    def linked(t: Array) -> tuple[Array, Linkage]:
        x, q = at_hand((jax.vmap(position)(flight, t), jax.vmap(orientation)(flight, t)))
        return q, linkage(world.joints, world.statics, world.bodies, x, q)

    if world.joints:
        q, link = linked(t)
        joined = frozenset(end for ends in ends_of(world.joints) for end in ends if end < len(q))
        inertia = jax.vmap(so.world_inverse)(world.bodies.inertia, q)
        x, v, L = (jax.vmap(of)(flight, t) for of in (position, velocity, angular_momentum))
        state = State(x=x, q=q, v=v, w=jax.vmap(so.unspin)(flight.inverse_inertia, q, L))
        answering = answers_of_forces(world, state, 2.0 * ago.max(0))
        return q, jointed(world.joints, link, linked(t - ago)[1], ago, inertia, joined, answering), link
    q = jax.vmap(orientation)(flight, t)
    inverse = jax.vmap(so.world_inverse)(flight.inverse_inertia, q)
    return q, Mobility(inverse_mass=flight.inverse_mass, inverse_inertia=inverse), None


def _anchored(flight: Flight, t: Array, q: Array, since: Array, kicked: tuple, moved: tuple) -> Anchors:
    """Re-anchor every body at its time t.

    Args:
        q: orientations at t.
        since: (N, *batch) [s] earliest time for which its new path holds.
        kicked: changes of v (N, D, *batch) [m/s] and L (N, A, *batch) [N m s].
        moved: displacement (N, D, *batch) [m] and turn (N, A, *batch) [rad]; L is kept in the turn.
    """
    so = rotations(flight.dim)

    def one(f: Flight, t: Array, q: Array, dv: Array, dL: Array, dx: Array, turn: Array) -> State:
        after = struck(f, t, so.turn_by(turn, q), dv, dL)
        return replace(after, x=after.x + dx)

    state = jax.vmap(one)(flight, t, q, *kicked, *moved)
    return Anchors(state=state, t0=t, since=since)
