"""Lever arms of a contact on its two bodies, at the end of the time for which it is held, and T/2 before and after.

A resting force acts evenly over that time T, so its impulse acts in the middle, when the contact was at p - (T/2) p',
the bodies at x - (T/2) v, and the normal was n - (T/2) n'. The arms and the normal of that moment conserve angular
momentum. The velocity that the impulse must cancel is that at the end, along the normal at the end. With the geometry
of the end for both, tipping, or sliding over a round body, would be of first order only.

At an impact within the step that velocity has to be right to higher order, or derivatives after the impact are of
first order. Until then the impulse has changed the velocity by u, and the pose by (T/2) u. With J the Jacobian of the
gap, the normal velocity J v has changed by

    J u + (T/2) (d(J v)/dx) u = (J + (T/2) dJ/dt) u

because second derivatives of a gap are symmetric: the change u acts at the arms, and along the normal, of T/2 after the
end. So it is for what is free to turn on what does not move, not for what lies flat; between two moving bodies it would
double what they gain or lose of their energy. A slip is measured at these arms, too, but along the tangents of the end:
as these turn they take up the normal velocity that is left, which is zero. What in space the change of pose adds to the
precession of a spin is left out.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.collide import Contacts
from diffrigid.contact.sides import Placed, Side, contacts_of
from diffrigid.fence import unfused
from diffrigid.flight import Flight, angular_momentum
from diffrigid.numerics import dot, safe_divide
from diffrigid.pytree import array, pytree
from diffrigid.state import rotations


@pytree
class Levers:
    """Lever arms of one contact from the centres of mass of a and b, (D, *batch) [m], world axes."""

    arm_a: Array = array("D")  # at the end
    arm_b: Array = array("D")
    late_a: Array = array("D")  # of changes of velocity: T/2 after the end where it rolls, else as at the end
    late_b: Array = array("D")
    mid_a: Any = array("D", default=None)  # of impulses, T/2 before the end; None: all are the same
    mid_b: Any = array("D", default=None)
    turn: Any = array("A", default=None)  # [rad] of the normal, from the end back to the middle; None: none
    lean: Any = array("D", default=None)  # [-] change of the normal from the end to T/2 after it; None: none
    rate: Any = array("D", default=None)  # [m/s] of the point of contact; None: not known


def levers(
    contact: Contacts, moving: Contacts | None, turns: bool, at_a: Placed, at_b: Placed, drift: Array, T: Array,
    rolls: Array,
) -> Levers:  # fmt: skip
    """Lever arms of one contact.

    Args:
        contact: one of a pair, with its gap if it is held, else with gap 0.
        moving: its rates. None: all arms are those in the middle, of a point that moves with the mean of both centres.
        turns: whether the normal may turn.
        drift: (D, *batch) [m/s] half the velocity of centre a relative to centre b; 0 at a static.
        T: (*batch) [s] time for which it is held, else 0.
        rolls: (*batch) bool: changes of velocity act late; not between two moving bodies.
    """
    normal, point, gap = contact.normal, contact.point, contact.gap
    inside = 0.5 * gap[None] * normal
    ends = point - at_a.x + inside, point - at_b.x - inside
    both_move, half = at_a.v is not None and at_b.v is not None, 0.5 * T[None]
    # Against a static, arms are to a body's own surface, not to the middle of a gap: it did not fall through it.
    mids = (point - at_a.x + half * drift, point - at_b.x - half * drift) if both_move else ends
    if moving is None:
        return Levers(arm_a=mids[0], arm_b=mids[1], late_a=mids[0], late_b=mids[1])
    sign = 0.0 if both_move else 1.0 if at_b.v is None else -1.0
    rate = moving.point + 0.5 * sign * moving.gap[None] * normal
    turned = half * (rate - (at_b.v if at_a.v is None else at_a.v - drift))
    size: Any = sum(dot(arm, arm) for arm, at in zip(ends, (at_a, at_b), strict=True) if at.v is not None)
    # Limited to the length of the arms: a body that turns faster than the steps resolve must not flip them.
    limit = safe_divide(size, size + 4.0 * dot(turned, turned))[None]
    turned = limit * turned
    turn = lean = None
    if turns:
        turn = -half * rotations(len(normal)).moment(normal, moving.normal)
        turn = turn / (1.0 + 4.0 * dot(turn, turn))[None]  # likewise
        if not both_move:
            lean = jnp.where(rolls[None], rotations(len(normal)).cross(-turn, normal), 0.0)
    late_a, late_b = ends
    if not both_move:
        ways = _less_spin(normal, ends, turned, (at_a, at_b), limit * half)
        late_a, late_b = (end + jnp.where(rolls[None], way, 0.0) for end, way in zip(ends, ways, strict=True))
    return Levers(
        arm_a=ends[0], arm_b=ends[1], late_a=late_a, late_b=late_b, mid_a=mids[0] - turned, mid_b=mids[1] - turned,
        turn=turn, lean=lean, rate=rate,
    )  # fmt: skip


def _less_spin(normal: Array, arms: tuple, way: Array, at: tuple, span: Array) -> list[Array]:
    """The way [m] of each of two arms in a span [s] without what a spin about the normal adds, which only turns the
    slip: friction is against that at the end. In the plane there is no such spin."""
    if len(normal) == 2:
        return [way, way]
    spins = [
        jnp.zeros_like(arm) if one.w is None else dot(normal, one.w)[None] * rotations(3).cross(normal, arm)
        for arm, one in zip(arms, at, strict=True)
    ]
    return [way - span * spin for spin in spins]


def with_rates(
    a: Side, at_a: Placed, b: Side, at_b: Placed, of: Callable[..., Contacts] = contacts_of
) -> tuple[Contacts, Contacts]:
    """Contacts `of` a pair, and their time derivatives at the bodies' velocities."""
    so = rotations(at_a.x.shape[0])
    poses = [(at.x, at.q) for at in (at_a, at_b)]
    rates = [
        tuple(map(jnp.zeros_like, pose)) if at.v is None else (at.v, unfused(so.rate, at.w, at.q))
        for at, pose in zip((at_a, at_b), poses, strict=True)
    ]

    def moved(a: Side, b: Side, poses: list, rates: list) -> tuple[Contacts, Contacts]:
        def placed(*poses: tuple) -> Contacts:
            at_a, at_b = (Placed(x=x, q=q) for x, q in poses)
            return of(a, at_a, b, at_b)

        return jax.jvp(placed, tuple(poses), tuple(rates))

    return unfused(moved, a, b, poses, rates)


def acceleration(f: Flight, at: Placed, s: Array, arm: Array) -> Array:
    """Mean acceleration, by forces and torques, of a point of a body from its anchor to s, (D, *batch) [m/s^2].

    What a spin adds to it is left out.
    """
    so, half = rotations(f.dim), 0.5 * (s - f.t0)[None]
    a = f.a if f.jolt is None else f.a + half * f.jolt
    if f.tau is None:
        return a
    tau = f.tau if f.twist is None else f.tau + half * f.twist
    return a + so.cross(so.apply(at.inverse_inertia, tau), arm)


def by_spin(f: Flight, at: Placed, s: Array, arm: Array, rate: Array) -> Array:
    """What a spin adds to the rate of a body's velocity where a contact moves along it, (D, *batch) [m/s^2].

    That is w x (p' - v), and in space dw/dt x r, where w changes without a torque (Euler's equations).

    Args:
        rate: (D, *batch) [m/s] velocity p' of the contact point.
    """
    so = rotations(f.dim)
    along = so.cross(at.w, rate - at.v)
    if f.dim == 2:
        return along
    return along + so.cross(so.apply(at.inverse_inertia, so.precession(angular_momentum(f, s), at.w)), arm)
