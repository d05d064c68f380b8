"""Limits, friction and motors of joints, as rows beside the contacts: each acts along the coordinate of one joint.

A limit is a contact in one dimension, with the gap coordinate - lower or upper - coordinate; it is struck at its time
within the step. Friction, or a motor, acts at the end of every step with the impulse that brings the rate to `speed`,
up to its bound. The scalars of a row are the first component of the vectors of a contact.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.constraints import by_twists, poses
from diffrigid.contact.approach import rounding, touches
from diffrigid.contact.gaps import NEAR
from diffrigid.contact.order import Meeting
from diffrigid.contact.resting import Strikes
from diffrigid.fence import at_hand
from diffrigid.flight import Flight, angular_momentum, orientation, position, velocity
from diffrigid.gathers import rows
from diffrigid.joints import Pose
from diffrigid.numerics import FOUND, implicit_root, safe_divide, unit_vector
from diffrigid.pytree import replace
from diffrigid.state import rotations

if TYPE_CHECKING:
    from diffrigid.world import World

SEARCH = 8  # Newton steps, kept in their bracket, for the time at which a nearly straight path strikes a limit


class Stop(NamedTuple):
    """One kind of row, which each joint of a group has."""

    group: int
    kind: str  # "lower", "upper" or "friction"


def stops_of(world: "World") -> tuple[Stop, ...]:
    """The rows of a world, for each group of joints one after the other."""
    kinds = ("lower", "upper", "friction")
    return tuple(Stop(k, kind) for k, g in enumerate(world.joints) for kind in kinds if _has(g, kind))


def stop_ends(world: "World", side: str) -> tuple[int, ...]:
    """Colliders of the rows; the world itself counts as the last."""
    return tuple(end for stop in stops_of(world) for end in getattr(world.joints[stop.group], side))


def is_drive(world: "World") -> tuple[bool, ...]:
    """Whether each row is friction or a motor, not a limit."""
    return tuple(stop.kind == "friction" for stop in stops_of(world) for _ in world.joints[stop.group].a)


def of_stops(world: "World", field: str, kinds: tuple[str, ...], other: float, batch: tuple[int, ...]) -> Array:
    """Values of the joints' `field` for rows of these `kinds`, and `other` for the rest, (R, *batch)."""
    parts = []
    for stop in stops_of(world):
        group = world.joints[stop.group]
        value = getattr(group, field) if stop.kind in kinds else None
        parts.append(jnp.full((len(group.a), *batch), other) if value is None else value)
    return jnp.concatenate([jnp.broadcast_to(part, part.shape[:1] + batch) for part in parts])


def meet_stops(world: "World", flight: Flight, since: Array, dt: Array, at_end: Array) -> Meeting:
    """Meetings of all rows: when each limit is struck, or the end of the step; friction and motors act at the end.

    Args:
        at_end: bool; True: all at the end of the step.
    """
    padded, parts = _with_statics(world, flight), []
    since = jnp.concatenate([since, jnp.broadcast_to(-dt, (len(world.static_names) + 1, *dt.shape))])
    for stop in stops_of(world):
        group, sides = _rows_of(world, stop, padded)
        latest = jnp.maximum(*(rows(since, ends) for ends in (world.joints[stop.group].a, world.joints[stop.group].b)))
        struck: Callable = partial(_struck, stop.kind, dt, at_end, world.contact.rest_speed)
        parts.append(jax.vmap(struck)(group, *sides, latest))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def find_stops(world: "World", flight: Flight, meeting: Meeting, dt: Array) -> Strikes:
    """Strikes of the rows of all joints, at their meetings."""
    padded, parts, start = _with_statics(world, flight), [], 0
    for stop in stops_of(world):
        group, sides = _rows_of(world, stop, padded)
        own = slice(start, start + len(world.joints[stop.group].a))
        row: Callable = partial(_row, stop.kind, dt)
        parts.append(jax.vmap(row)(group, *sides, jax.tree.map(lambda leaf, own=own: leaf[own], meeting)))
        start = own.stop
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _rows_of(world: "World", stop: Stop, padded: Flight) -> tuple[Any, list[Flight]]:
    """The joints of a group, and the flights of their bodies."""
    group = world.joints[stop.group]
    sides = [jax.tree.map(lambda leaf, ends=ends: rows(leaf, ends), padded) for ends in (group.a, group.b)]
    return replace(group, a=None, b=None), sides


def _gap(kind: str, joint: Any, a: Flight, b: Flight) -> Callable[[Array], Array]:
    """Gap [m or rad] of a limit at any time of the paths; of a hinge continuous from where they begin, within pi."""
    so, sign = rotations(a.dim), -1.0 if kind == "upper" else 1.0

    def coordinate(s: Array) -> Array:
        return joint.coordinate(so, *(Pose(position(f, s), orientation(f, s)) for f in (a, b)))

    first = None if joint.period is None else lax.stop_gradient(coordinate(jnp.maximum(a.t0, b.t0)))

    def gap(s: Array) -> Array:
        at = coordinate(s)
        if first is not None:
            at = at + joint.period * jnp.round((first - lax.stop_gradient(at)) / joint.period)
        return sign * (at - getattr(joint, kind))

    return gap


def _struck(
    kind: str, dt: Array, at_end: Array, rest_speed: Array, joint: Any, a: Flight, b: Flight, since: Array
) -> Meeting:
    """Meeting of one row: when its limit is struck, or the end of the step.

    The path is followed back to `since`, before the step: a limit that was missed there is still struck at its time.
    One that is not open then, and exceeded at the end, is struck at once.
    """
    if kind == "friction":
        never = jnp.zeros(dt.shape, bool)
        return Meeting(s=dt, hit=never | at_end, fast=never, rests=~never[None])
    gap, start = _gap(kind, joint, a, b), jnp.maximum(a.t0, b.t0)
    (frozen_joint, *sides), begin, end = lax.stop_gradient(((joint, a, b), since, dt))
    frozen = _gap(kind, frozen_joint, *sides)  # for the search: else it carries tangents in vain
    near = _near(joint, a, b, begin)
    free, inside = frozen(begin) > rounding(near), frozen(end) < 0

    def closer(_, ends):
        low, high, s = ends
        value, slope = _rate(frozen, s)
        low, high = jnp.where(value > 0, s, low), jnp.where(value > 0, high, s)
        newton = s - value / jnp.where(slope != 0, slope, 1.0)
        within = (newton >= low) & (newton <= high) & (slope != 0)
        return low, high, jnp.where(within, newton, 0.5 * (low + high))

    found = lax.fori_loop(0, SEARCH, closer, (begin, end, 0.5 * (begin + end)))[2]
    start = lax.stop_gradient(start)
    passes = _passes(frozen_joint, *_rate(frozen, start), near)
    hit = inside & ~at_end & ~passes
    s0 = checkpoint_name(lax.stop_gradient(jnp.where(hit & free, found, jnp.where(hit, start, dt))), FOUND)
    value, slope = _rate(gap, s0)
    slope = lax.stop_gradient(slope)
    s = jnp.where(hit & free, implicit_root(s0, value, slope), jnp.where(hit, jnp.maximum(a.t0, b.t0), dt))
    rests = touches(*_rate(frozen, start), _second(frozen, start), near, rest_speed) & ~at_end & ~passes
    return Meeting(s=s, hit=hit | at_end, fast=hit & (slope < -rest_speed), rests=rests[None])


def _passes(joint: Any, gap: Array, rate: Array, near: Array) -> Array:
    """Whether a limit with this gap and its rate is only passed on the way back, (*batch) bool.

    A hinge with one limit that turns away from it comes to its other side, by a whole turn: nothing stops it there.
    """
    one_limit = joint.period is not None and (joint.lower is None or joint.upper is None)
    return (gap < -near) & (rate > 0) if one_limit else jnp.zeros_like(gap, bool)


def _rate(gap: Callable, s: Array) -> tuple[Array, Array]:
    """Gap at time s, and its rate."""
    return jax.jvp(gap, (s,), (jnp.ones_like(s),))


def _near(joint: Any, a: Flight, b: Flight, s: Array) -> Array:
    """Gap (*batch) [m or rad] up to which a limit is near."""
    return NEAR * lax.stop_gradient(joint.scale(*(Pose(position(f, s), f.q) for f in (a, b))))


def _row(kind: str, dt: Array, joint: Any, a: Flight, b: Flight, meeting: Meeting) -> Strikes:
    so, sign, s = rotations(a.dim), -1.0 if kind == "upper" else 1.0, meeting.s
    poses: Any = at_hand([Pose(position(f, s), orientation(f, s)) for f in (a, b)])
    inverses = [so.world_inverse(f.inverse_inertia, pose.q) for f, pose in zip((a, b), poses, strict=True)]
    spins = [so.apply(i, angular_momentum(f, s)) for i, f in zip(inverses, (a, b), strict=True)]
    twists = [jnp.concatenate([velocity(f, s), w]) for f, w in zip((a, b), spins, strict=True)]
    middle = s - 0.5 * jnp.where(meeting.held, s - jnp.maximum(a.t0, b.t0), 0.0)
    then: Any = at_hand([Pose(position(f, middle), orientation(f, middle)) for f in (a, b)])
    both = jax.tree.map(lambda *two: jnp.stack(two), poses, then)
    along = jax.vmap(lambda a, b: by_twists(so, lambda a, b: joint.coordinate(so, a, b)[None], a, b)[0])(*both)
    jac, mid_jac = sign * along.reshape(2, 2, so.D + so.A, *s.shape)
    rate = (jac * jnp.stack(twists)).sum((0, 1))
    mobile = [f.inverse_mass * (j[: so.D] ** 2).sum(0) for f, j in zip((a, b), jac, strict=True)]
    mobile += [(j[so.D :] * so.apply(i, j[so.D :])).sum(0) for i, j in zip(inverses, jac, strict=True)]
    first = unit_vector(jnp.zeros((so.D, *s.shape), s.dtype), 0)
    none, gap = jnp.zeros_like(first), _gap(kind, joint, a, b)
    start = jnp.maximum(a.t0, b.t0)
    if kind == "friction":  # mean acceleration since the paths begin
        open_by = begins_at = jnp.zeros_like(s)
        passes = jnp.zeros_like(s, bool)
        pull = safe_divide(rate - _rate(gap, start)[1], s - start)
    else:
        open_by, (begins_at, opens) = gap(s), _rate(gap, start)
        passes = _passes(joint, begins_at, opens, _near(joint, a, b, start))
        pull = lax.stop_gradient(_second(gap, s))
    # Also a limit that has opened as its bodies fell away, or that was shut where their paths begin, and may have
    # rebounded: it may close again once they are held.
    falls = [jnp.concatenate([f.a, so.apply(i, f.tau)]) for i, f in zip(inverses, (a, b), strict=True)]
    closed = rounding(_near(joint, a, b, s))
    near = open_by <= closed + dt**2 * jnp.abs((jac * jnp.stack(falls)).sum(1)).sum(0)
    near = near | (begins_at <= _near(joint, a, b, start))
    return Strikes(
        active=meeting.hit & (~meeting.held | meeting.rests[0] | near) & ~passes, s=s, gap=open_by, rounding=closed,
        deepest=jnp.full_like(s, jnp.inf), normal=first, arm_a=none, arm_b=none,
        K=first[:, None] * first[None] * sum(mobile)[None, None], v_rel=rate[None] * first, press=-pull,
        pull=pull[None] * first, drift=none, rests=meeting.rests[0], now=meeting.now, held=meeting.held,
        jac=jac, mid_jac=mid_jac,
    )  # fmt: skip


def _second(gap: Callable, s: Array) -> Array:
    """Second time derivative of the gap."""
    one = jnp.ones_like(s)
    return jax.jvp(lambda s: jax.jvp(gap, (s,), (one,))[1], (s,), (one,))[1]


def _with_statics(world: "World", flight: Flight) -> Flight:
    """The flights of all colliders: bodies, then statics and the world, which do not move."""
    count, every = len(world.static_names) + 1, poses(world.statics, flight.x, flight.q)
    still = jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape[1:]), leaf.dtype), flight)
    all_flights = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), flight, still)
    return replace(all_flights, x=every.x, q=every.q)


def _has(group: Any, kind: str) -> bool:
    return getattr(group, kind, None) is not None
