"""One list of all contacts of a world, whatever the kinds of their shapes, followed by the rows of its joints."""

import functools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.branches import any_world
from diffrigid.collide import Contacts, PairGroup
from diffrigid.collide.contacts import THERE, transferred
from diffrigid.collide.heights import height_over
from diffrigid.collide.profile import clearance
from diffrigid.contact.held_up import held_up, is_supported
from diffrigid.contact.impact import find_impact
from diffrigid.contact.impulse import effective_matrix
from diffrigid.contact.levers import acceleration, by_spin, levers, with_rates
from diffrigid.contact.materials import material, mixed
from diffrigid.contact.nearing import EXACT_BEYOND
from diffrigid.contact.order import Links, Meeting, at_once, companions, in_order
from diffrigid.contact.resting import Strikes, are_alone
from diffrigid.contact.sides import (
    Side,
    began,
    centre,
    contacts_of,
    difference,
    gap_rounding,
    place,
    reach_of,
    relative_velocity,
    sides_of,
    smaller_size,
)
from diffrigid.contact.stops import find_stops, is_drive, meet_stops, of_stops, stop_ends, stops_of
from diffrigid.elimination import islands
from diffrigid.fence import unfused
from diffrigid.flight import Flight
from diffrigid.forces import is_uniform
from diffrigid.gathers import flags
from diffrigid.joints import Weld
from diffrigid.linkage import ends_of
from diffrigid.numerics import dot, norm
from diffrigid.pytree import replace
from diffrigid.shapes import Capsule, Disc, HalfSpace, HeightField, Profile, Sphere
from diffrigid.state import rotations

if TYPE_CHECKING:
    from diffrigid.world import World

DEEPEST = 0.2  # [-] of the smaller reach: deeper penetration is resolved in several steps


def find_strikes(
    world: "World", flight: Flight, since: Array, dt: Array, at_end: Array, resting: Array, supported: Array | None
) -> Strikes:
    """List the contacts of every pair at its next impact, or the time it is held until; `at_end` (bool): at the end.

    Active are contacts that touch then, those of an impact only if it happens before the end. A contact that was
    `resting` (C, *batch) still touches if it has opened by no more than a body falls in a step. Bodies that are
    `supported` (N, *batch) where their paths begin are held up, see `HeldUp`.
    """
    width = world.contact.width
    groups = [sides_of(world, pairs, flight, since, supported) for pairs in world.pairs]
    rested, start = [], 0
    for pairs in world.pairs:
        rows = len(pairs.a) * pairs.count
        rested.append(resting[start : start + rows].reshape(-1, pairs.count, *dt.shape))
        start += rows
    meets = jax.vmap(lambda a, b, rested: next_meeting(world, a, b, dt, rested.any(0), at_end, width))
    meetings = [meets(*sides, own) for sides, own in zip(groups, rested, strict=True)]
    a, b = pair_ends(world)
    meetings = at_once(meetings, a, b)
    if stops_of(world):
        meetings.append(meet_stops(world, flight, since, dt, at_end))
    bounces = _coefficients(world, "restitution", a, b, dt.shape) > 0 if waits(world) else None
    a, b = a + stop_ends(world, "a"), b + stop_ends(world, "b")
    links = Links(a, b, companions(world))
    meetings = in_order(meetings, links, flight.t0, dt, at_end, bounces)
    parts, jacs = [], {}
    for sides, meeting, own in zip(groups, meetings, rested, strict=False):
        each = jax.vmap(functools.partial(strikes_of, dt=dt, loaded=is_loaded(world)))
        part = unfused(each, *sides, meeting, own)
        parts.append(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), part))
    if stops_of(world):
        stops = find_stops(world, flight, meetings[-1], dt)
        jacs = {"jac": stops.jac, "mid_jac": stops.mid_jac}
        mid = stops.arm_a if is_loaded(world) else None
        parts.append(replace(stops, jac=None, mid_jac=None, mid_a=mid, mid_b=mid))
    return replace(_joined(parts), **ends(world), wholes=wholes(world), **jacs)


def _joined(parts: list[Strikes]) -> Strikes:
    """Concatenate the lists; `turn` and `lean`, if any has them, are zero in those that do not."""
    if len(parts) == 1:
        return parts[0]
    for name, axes in (("turn", rotations(parts[0].arm_a.shape[1]).A), ("lean", None)):
        if any(getattr(part, name) is not None for part in parts):
            parts = [
                replace(part, **{name: jnp.zeros_like(part.arm_a[:, :axes])}) if getattr(part, name) is None else part
                for part in parts
            ]
    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *parts)


def waits(world: "World") -> bool:
    """Whether resting contacts may have to be held until an impact. Static.

    That is so beside friction or motors of joints, and with loads where a body may touch several others, or one of
    them at several points.
    """
    drives = driven(world)
    joined = tuple(dict.fromkeys(zip(stop_ends(world, "a"), stop_ends(world, "b"), strict=True)))
    a, b = zip(*zip(*pair_ends(world), strict=True), *joined, strict=True)
    alone = are_alone(a, b, len(world.names)) and all(pairs.count == 1 for pairs in world.pairs)
    return not all(drives) and (any(drives) or (is_loaded(world) and not alone))


def is_loaded(world: "World") -> bool:
    """Whether resting contacts may carry a load. Static.

    They do by forces and joints, and without both by rotation: a side that turns presses what slips along it, or lies
    on it. Round bodies have no sides, and corners on a half-space swing away from it; a round end off the centre of
    mass may swing towards it.
    """

    def turns_a_side(pairs: PairGroup) -> bool:
        groups = pairs.shape_a, pairs.shape_b
        shapes = [world.shapes[group] for group in groups]
        if any(isinstance(world.shapes[g], Disc | Sphere | Capsule) and world.offsets[g] is not None for g in groups):
            return True
        return not isinstance(shapes[1], HalfSpace) and not all(isinstance(shape, Disc | Sphere) for shape in shapes)

    return bool(world.forces or world.joints) or any(map(turns_a_side, world.pairs))


def next_meeting(
    world: "World", a: Side, b: Side, dt: Array, rested: Array, at_end: Array, width: Array | None
) -> Meeting:
    """The next impact of one pair, or the end of the step where `at_end` (a bool)."""
    straight = relative_path_is_straight(world, a.flight is not None and b.flight is not None)
    return find_impact(a, b, dt, width, straight, world.contact.rest_speed, rested, at_end)


def next_strikes(world: "World", a: Side, b: Side, dt: Array) -> Strikes:
    """The contacts of one pair at its next exact impact, (K, ...)."""
    never = jnp.zeros(dt.shape, bool)
    meeting = next_meeting(world, a, b, dt, never, jnp.asarray(False), None)
    meeting = replace(meeting, now=meeting.fast, joins=never, held=never)
    return strikes_of(a, b, meeting, never[None], dt, loaded=False)


def strikes_of(a: Side, b: Side, meeting: Meeting, rested: Array, dt: Array, loaded: bool) -> Strikes:
    """Contacts of one pair, (K, ...); see `find_strikes`. `loaded`: whether resting contacts may carry a load."""
    s, held = meeting.s, meeting.held
    at_a, at_b = place(a, s), place(b, s)
    up = held_up(a, at_a, b, at_b, s)
    at_a, at_b = up.at_a, up.at_b
    contacts, moving = with_rates(a, at_a, b, at_b) if loaded else (contacts_of(a, at_a, b, at_b), None)
    gaps, apart = up.gaps(contacts), held | is_supported(a, b)  # else the two are where they strike
    rests = transferred(meeting.rests, meeting.feature, contacts.feature)
    # Also contacts that opened because the body below fell away: they may close again once it is held, or struck.
    fall = dt**2 * sum(norm(at.a) for at in (at_a, at_b) if at.a is not None)
    opened = jnp.where((held | meeting.joins)[None] | rested, fall[None], 0.0)
    near = gaps <= (meeting.level + meeting.slack)[None] + opened
    there = gaps < THERE  # what rested may have left the face on which it did
    active = (near | (rests & held[None])) & there & meeting.hit[None]
    both_move = a.flight is not None and b.flight is not None
    drift = 0.5 * (at_a.v - at_b.v) if both_move else jnp.zeros_like(at_a.x)  # type: ignore[operator]
    size, rounding = smaller_size(a, b), gap_rounding(a, at_a, b, at_b)
    T, turns = jnp.where(held, s - began(a, b), 0.0), both_move or not isinstance(b.shape, HalfSpace)
    rolls = (active & near & (rests | rested)).sum(0) < len(at_a.x)

    def each(contact: Contacts, moving: Contacts | None, gap: Array) -> Strikes:
        at_gap = replace(contact, gap=jnp.where(apart, contact.gap, 0.0))
        lever = levers(at_gap, moving, turns, at_a, at_b, drift, T, rolls)
        sides = at_a, (a.flight, lever.arm_a), at_b, (b.flight, lever.arm_b)
        forces = difference(lambda at, of: acceleration(of[0], at, s, of[1]), *sides)
        v_rel = relative_velocity(at_a, lever.arm_a, at_b, lever.arm_b)
        pull = forces
        if moving is not None:
            pull = pull + difference(lambda at, of: by_spin(of[0], at, s, of[1], lever.rate), *sides)
            if turns:  # the normal velocity changes as the normal does, too
                pull = pull + dot(moving.normal, v_rel)[None] * contact.normal
        return Strikes(
            active=gap < 0, s=s, gap=gap, rounding=rounding, deepest=DEEPEST * size, normal=contact.normal,
            arm_a=lever.late_a, arm_b=lever.late_b, mid_a=lever.mid_a, mid_b=lever.mid_b, turn=lever.turn,
            lean=lever.lean, K=effective_matrix(at_a, at_b, contact.normal, lever), v_rel=v_rel,
            press=-dot(contact.normal, forces), pull=pull, drift=drift, rests=gap < 0, now=meeting.now, held=held,
        )  # fmt: skip

    return replace(jax.vmap(each)(contacts, moving, gaps), active=active, rests=rests)


def relative_path_is_straight(world: "World", both_move: bool) -> bool:
    """Whether relative paths are straight lines: two bodies may fall alike, but not a body and a static."""
    return is_uniform(world.forces) and not world.joints if both_move else not (world.forces or world.joints)


def may_meet(world: "World", flight: Flight, dt: Array) -> Array:
    """False (a bool) if no two bounding spheres of any pair in any world of the batch can touch within the step.

    The test costs a fraction of the search for impacts, and lets a step without any skip everything else.
    """
    width = world.contact.width
    margin = 0.0 if width is None else EXACT_BEYOND * width  # beyond it a smooth impulse is below rounding

    def one(a: Side, b: Side) -> Array:
        a, b = lax.stop_gradient((a, b))
        start = jnp.zeros_like(dt)
        (x_a, v_a), (x_b, v_b) = centre(a, start), centre(b, start)
        if isinstance(b.shape, HalfSpace):
            n = rotations(x_a.shape[0]).rotate(b.q, b.shape.normal)
            apart, speed = dot(n, x_a - x_b) - b.shape.offset - reach_of(a), jnp.abs(dot(n, v_a - v_b))
        elif isinstance(b.shape, Profile):
            p = rotations(2).unrotate(b.q, x_a - x_b)
            apart, speed = clearance(b.shape, p) - reach_of(a), norm(v_a - v_b)
        elif isinstance(b.shape, HeightField):
            apart, speed = height_over(b.shape, x_a, b.x, b.q) - reach_of(a), norm(v_a - v_b)
        else:
            apart, speed = norm(x_a - x_b) - reach_of(a) - reach_of(b), norm(v_a - v_b)
        pull = jnp.zeros_like(dt)
        for f in (side.flight for side in (a, b) if side.flight is not None):
            pull = pull + norm(f.a) + (0.0 if f.jerk is None else dt * norm(f.jerk))
        return apart <= dt * (speed + 0.5 * dt * pull) + margin

    since = jnp.zeros_like(flight.t0)
    if stops_of(world):
        return jnp.asarray(True)
    near = [any_world(jax.vmap(one)(*sides_of(world, pairs, flight, since))) for pairs in world.pairs]
    return functools.reduce(jnp.logical_or, near)


def pair_ends(world: "World") -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Colliders a, and colliders b, of every pair."""
    a, b = (tuple(i for pairs in world.pairs for i in getattr(pairs, side)) for side in "ab")
    return a, b


def ends(world: "World") -> dict[str, tuple[int, ...]]:
    """Colliders a and b of every contact, then of every row of a joint."""

    def column(of):
        return tuple(int(i) for pairs in world.pairs for i in np.repeat(of(pairs), pairs.count))

    a, b = column(lambda pairs: pairs.a), column(lambda pairs: pairs.b)
    return {"a": a + stop_ends(world, "a"), "b": b + stop_ends(world, "b")}


def wholes(world: "World") -> tuple:
    """Label each contact or row by the two rigid clusters it connects (welded bodies are one; so are all statics)."""
    moving, count, pairs = len(world.names), contact_count(world), ends(world)
    whole = [min(body) for body in islands(ends_of(g for g in world.joints if isinstance(g, Weld)), moving)]

    def label(ends: tuple[int, int]) -> tuple:
        return tuple(sorted(whole[i] if i < moving else moving for i in ends))

    both = list(zip(pairs["a"], pairs["b"], strict=True))
    return tuple(map(label, both[:count])) + tuple(("joint", *ends) for ends in both[count:])


def coefficients(world: "World", name: str, batch: tuple[int, ...]) -> Array:
    """Coefficient `name` of all contacts and rows of joints, (C, *batch) or broadcastable to it."""
    index = {side: ends(world)[side][: contact_count(world)] for side in "ab"}
    return _coefficients(world, name, index["a"], index["b"], batch)


def _coefficients(world: "World", name: str, a: tuple[int, ...], b: tuple[int, ...], batch: tuple[int, ...]) -> Array:
    """Coefficient `name` between colliders a and b, followed by that of the rows of joints."""
    parts = [mixed(*(material(world, name, side) for side in (a, b)))] if world.pairs else []
    if stops_of(world):
        kinds = ("lower", "upper") if name == "restitution" else ()
        parts.append(of_stops(world, "restitution", kinds, 0.0, batch))
    whole = [jnp.broadcast_to(part, part.shape[:1] + batch) for part in parts]
    return jnp.concatenate(whole) if len(parts) > 1 else parts[0]


def is_rolling(world: "World") -> bool:
    """Whether there is friction against rolling or spinning. Static."""
    bodies = world.bodies
    return bool(world.pairs) and not (bodies.rolling_friction is None and bodies.spinning_friction is None)


def driven(world: "World") -> tuple[bool, ...]:
    """Whether each contact or row is joint friction or a motor (two-sided, always active)."""
    return (False,) * contact_count(world) + is_drive(world)


def driving(world: "World", target: Array) -> tuple[Array, Array | None]:
    """`target` with the speeds of motors filled in, and bounds of joint friction and motors [N or N m]; None: none."""
    if not any(is_drive(world)):
        return target, None
    drives = flags(is_drive(world), target)
    speed, force = (of_stops(world, name, ("friction",), 0.0, target.shape[1:]) for name in ("speed", "friction"))
    points = contact_count(world)
    target = jnp.concatenate([target[:points], jnp.where(drives, speed, target[points:])])
    return target, jnp.concatenate([jnp.zeros_like(target[:points]), force])


def contact_count(world: "World") -> int:
    """Number of contacts of all pairs, without the rows of joints."""
    return sum(len(pairs.a) * pairs.count for pairs in world.pairs)
