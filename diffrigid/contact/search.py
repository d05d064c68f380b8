"""When any two shapes meet: conservative advancement towards the first contact, then the parabola of its gap.

Searched without derivatives; `impact.py` gives the time that is found that of the implicit function theorem.
Source: Mirtich, Impulse-based Dynamic Simulation of Rigid Body Systems (1996), for the advancement.
"""

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.branches import any_world, opaque_true
from diffrigid.collide import Contacts
from diffrigid.collide.heights import height_over, unseen_for
from diffrigid.contact.sides import (
    Placed,
    Side,
    candidates_of,
    centre,
    earliest,
    gap_rates,
    place,
    reach_of,
    relative_acceleration,
)
from diffrigid.gathers import MANY, fold
from diffrigid.numerics import FOUND, dot, norm, safe_divide, safe_sqrt, softplus
from diffrigid.shapes import HalfSpace, HeightField, radius, vertices
from diffrigid.state import rotations

CROSSED = 3  # advances for each node along a side of a grid: the length of its diagonal in half cells
ADVANCES = 48  # conservative advances at most, each at least the gap over a bound on the closing speed
POLISH = 6  # steps along the local parabola of the gap; error squared by each
ROUNDING = 1e5  # [-] of the last digit of NEAR: how far rounding of their places may hold bodies apart
NEAR = 1e-3  # [-] fraction of the smaller reach at which advancing hands over to polishing


def approach_search(
    a: Side, b: Side, t1: Array, width: Array | None, rest_speed: Array, at_end: Array
) -> tuple[Array, Array, Array, Array]:
    """Any two shapes: conservative advancement to the neighbourhood, then the parabola of the next contact.

    Nothing is looked for `at_end`, a bool.
    """
    start, bound = earliest(a, b)
    frozen_a, frozen_b = lax.stop_gradient((a, b))
    size = jnp.minimum(reach_of(a), reach_of(b))
    near, rests = _advance(frozen_a, frozen_b, start, t1, size, lax.stop_gradient(rest_speed), at_end)
    near, rests = checkpoint_name((near, rests), FOUND)
    live = opaque_true(t1)

    def smooth(near):
        return _closest_level(a, b, near, t1 - start, width, live)  # type: ignore[arg-type]

    level = if_smooth(width, smooth, jnp.zeros_like, near)
    s, found = _polish(frozen_a, frozen_b, near, lax.stop_gradient(level), size, start, t1, rests, at_end, live)
    return jnp.where(s < bound, start, s), level, found, rests


def if_smooth(width: Array | None, smooth, exact, *args: Array) -> Array:
    """smooth(*args) if any width is positive, else exact(*args)."""
    return exact(*args) if width is None else lax.cond(any_world(width > 0), smooth, exact, *args)


def touches(gap: Array, v: Array, acc: Array, near: Array, slow: Array) -> Array:
    """Whether a gap is closed, or about to close, no faster than `slow` [m/s]; rounding does not keep it open."""
    open_by = jnp.maximum(gap - ROUNDING * jnp.finfo(gap.dtype).eps * near, 0.0)
    return (gap <= near) & (v * v + 2.0 * open_by * jnp.abs(acc) <= slow**2)


def _motion(a: Side, b: Side, s: Array, live: Array) -> tuple[Array, Array, Array, Array | None]:
    """Gaps of the contacts at s, (K, *batch) [m], their rates [m/s] and accelerations [m/s^2], and their normals."""
    at_a, at_b = place(a, s, live), place(b, s, live)
    if isinstance(b.shape, HalfSpace):
        return *_corner_motion(a, at_a, b), None
    contacts = candidates_of(a, at_a, b, at_b)

    def pull(n, p):
        return dot(n, relative_acceleration(at_a, at_b, p))

    acceleration = jax.vmap(pull)(contacts.normal, contacts.point)
    return contacts.gap, gap_rates(contacts, at_a, at_b), acceleration, contacts.normal


def _corner_motion(a: Side, at: Placed, b: Side) -> tuple[Array, Array, Array]:
    """Heights of all corners of a above a half-space, (V, *batch) [m], their rates and accelerations.

    In body axes the height of a corner r is n . x + N . r with N = R^T n; so are its derivatives, with those of N.
    """
    dim = len(at.x)
    so = rotations(dim)
    normal = so.rotate(b.q, b.shape.normal)
    r = _corners(a, dim)
    turning = so.cross(at.w, normal)
    axes = [normal, -turning, so.cross(at.w, turning) - so.cross(at.dw, normal)]
    heights = [dot(normal, at.x - b.x) - b.shape.offset - radius(a.shape), dot(normal, at.v), dot(normal, at.a)]
    height, rate, acceleration = (
        h[None] + jax.vmap(dot, (None, 0))(so.unrotate(at.q, n), r) for h, n in zip(heights, axes, strict=True)
    )
    return height, rate, acceleration


def at_corners(a: Side, at: Placed, contacts: Contacts, of_corners: Array) -> Array:
    """What holds of corners of a, (V, *batch) bool, for contacts with a half-space at some of them, (K, *batch)."""
    so, margin = rotations(len(at.x)), NEAR * reach_of(a)

    def one(gap: Array, normal: Array, point: Array) -> Array:
        corner = so.unrotate(at.q, point + (radius(a.shape) + 0.5 * gap)[None] * normal - at.x)
        return (of_corners & (jax.vmap(norm)(_corners(a, len(at.x)) - corner[None]) <= margin[None])).any(0)

    return lax.stop_gradient(jax.vmap(one)(contacts.gap, contacts.normal, contacts.point))


def _corners(a: Side, dim: int) -> Array:
    """Vertices of the core of a from its centre of mass, body axes, (V, D, *batch) [m]."""
    r = vertices(a.shape, dim)
    return r if a.offset is None else r + a.offset[None]


def _time_to(height: Array, v: Array, acc: Array) -> Array:
    """Time until height + v t + acc t^2 / 2 next falls through zero; negative if inside and closing; inf: never."""
    D = v * v - 2.0 * acc * height
    root = safe_sqrt(D)
    closing = jnp.where((D < 0) & (height > 0), jnp.inf, safe_divide(2.0 * height, root - v))
    returning = jnp.where(acc < 0, safe_divide(v + root, -acc), jnp.inf)
    sunk = (height < 0) & (acc < 0) & (D < 0)
    return jnp.where(sunk, 0.0, jnp.where(v < 0, closing, returning))


def _advance(a: Side, b: Side, start: Array, t1: Array, size: Array, slow: Array, at_end: Array) -> tuple[Array, Array]:
    """Advance until a contact is near and closing, or the step is over; and which contacts (K, *batch) rest.

    Contacts rest that touch, or are about to, and close no faster than `slow` [m/s]; beside one, so do those slow
    enough to come to rest anyway. They are left out: in unsupported flight they would always close next, and hide the
    fast impact of another corner.

    Each advance is the least, over the contacts, of the gap over a bound on the closing speed for the present
    normal (Mirtich 1996), so that a body that only translates arrives in one. The gap of a corner and a plane is
    a smooth function of time: until t1 it stays above the parabola that is its own, bent down further by as much as its
    third derivative can be, which takes two or three advances. A contact that touches and separates may be passed for
    as long as its parabola stays open.
    """
    live, span, near = opaque_true(t1), jnp.maximum(t1 - start, 0.0), NEAR * size
    (spin_a, jerk_a), (spin_b, jerk_b) = _unsteady(a, span), _unsteady(b, span)
    spinning, jerk = spin_a + spin_b, jerk_a + jerk_b
    # Across a grid an advance ends after half a cell, or in contact.
    most = ADVANCES + (CROSSED * sum(b.shape.heights.shape[:2]) if isinstance(b.shape, HeightField) else 0)

    def safe_time(gap, v, acc, normal, rests, s):
        if normal is None:
            apart = _time_to(gap, v, acc - jerk[None] * jnp.maximum(t1 - s, 0.0)[None] / 3.0)
        else:
            approach = centre(a, s)[1] - centre(b, s)[1]
            bound = jnp.maximum(-(normal * approach[None]).sum(1), 0.0) + spinning[None]
            apart = jnp.where(bound > 0, safe_divide(gap, bound), jnp.inf)
        returns = jnp.where(v < 0, 0.0, _time_to(gap, v, acc))
        first = _least(jnp.where(rests, jnp.inf, jnp.where(gap > near[None], apart, returns)))
        return jnp.minimum(first, unseen(s)) if isinstance(b.shape, HeightField) else first

    def unseen(s):
        x, v = centre(a, s)
        height = height_over(b.shape, x, b.x, b.q) - reach_of(a)
        return jnp.where(s < t1, unseen_for(b.shape, b.q, height, v, spinning), jnp.inf)

    def busy(carry):
        count, s, dt, _ = carry
        return ~at_end & ((count == 0) | ((count < most) & any_world((dt > 0) & (s < t1))))

    def advance(carry):
        count, s, dt, rests = carry
        onward = jnp.where(s < t1, jnp.minimum(s + jnp.maximum(dt, 0.0), t1), s)
        gap, v, acc, normal = _motion(a, b, onward, live)
        touching = touches(gap, v, acc, near[None], slow[None])
        # Beside one that rests, what closes by a third of its fall: it would be back within the step, whatever e <= 1.
        least = slow[None] + jnp.maximum(-acc, 0.0) * span[None] / 3.0
        beside = touches(gap, v, acc, near[None], least) & touching.any(0)[None]
        rests = jnp.where(count == 0, touching | beside, rests)
        return count + 1, onward, safe_time(gap, v, acc, normal, rests, onward), rests

    contacts = jax.eval_shape(lambda: _motion(a, b, start, live)[0]).shape
    begin = jnp.where(at_end, t1, start)
    return lax.while_loop(busy, advance, (0, begin, jnp.zeros_like(start), jnp.zeros(contacts, bool)))[1::2]


def _least(times: Array) -> Array:
    """Of the contacts (K, *batch). Written out only where they are few: the program is not to grow with a grid."""
    return fold(jnp.minimum, times, 0) if len(times) <= MANY else times.min(0)


def _unsteady(side: Side, span: Array) -> tuple[Array, Array]:
    """Bounds within the step on what spin and acceleration add to the speed of a point, and on its third derivative.

    (*batch) [m/s], [m/s^3]. Without a torque a rigid body has no greater angular acceleration than w^2, which bounds
    the third derivative of an arm r by 6 w^3 r.
    """
    f = side.flight
    if f is None:
        return jnp.zeros_like(span), jnp.zeros_like(span)
    so, reach = rotations(f.dim), reach_of(side)
    w, a = norm(so.unspin(f.inverse_inertia, f.q, f.L)), norm(f.a)
    jerk = 8.0 * w * w * w * reach
    if f.jerk is not None:
        a, jerk = a + span * norm(f.jerk), jerk + norm(f.jerk)
    if f.tau is not None:
        jerk = jerk + 4.0 * w * reach * norm(so.unspin(f.inverse_inertia, f.q, f.tau))
    return 1.1 * w * reach + a * span, jerk


def _polish(
    a: Side, b: Side, s: Array, level: Array, size: Array, start: Array, t1: Array, rests: Array, at_end: Array,
    live: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Time near s at which the first contact comes to gap = level, and whether one does; s if inside and closing.

    Not of contacts that rest, (K, *batch) bool.
    """
    slack, near, span = jnp.sqrt(jnp.finfo(s.dtype).eps), s, t1 - start

    def busy(carry):
        count, _, dt, *_ = carry
        return ~at_end & (count <= POLISH) & any_world(jnp.abs(dt) > slack * span)

    def towards(carry):
        count, s, _, _, inside = carry
        gap, v, acc, _ = _motion(a, b, s, live)
        height = gap - level[None]
        there = (jnp.abs(height) <= 8.0 * slack**2 * size[None]) & (v < 0)  # to rounding
        dt = _least(jnp.where(rests, jnp.inf, jnp.where(there, 0.0, _time_to(height, v, acc))))
        dt = jnp.where(jnp.isfinite(dt) & ((dt < 0) | (s < t1 + slack * span)), dt, 0.0)  # what is later is no impact
        at_level = (gap <= (level + slack * size)[None]) & ((v < 0) | (acc < 0)) & ~rests
        inside = jnp.where(count == 0, ((gap <= level[None]) & (v < 0) & ~rests).any(0), inside)
        return count + 1, s + dt, dt, at_level.any(0), inside

    _, s, dt, found, inside = lax.while_loop(busy, towards, (0, s, jnp.inf + s, s < s, s < s))
    # Where it converges the last step closes the gap, which at its start may have been wider than the slack.
    found = found | ((dt != 0) & (jnp.abs(dt) <= slack * span))
    return jnp.where(found, s, near), found | inside


def _closest_level(a: Side, b: Side, s: Array, span: Array, width: Array, live: Array) -> Array:
    """Smooth level from the closest approach of the two paths, of the contact with the least gap at s.

    The curvature of the gap is a difference of its rate over a quarter of the step: it holds what corners and
    turning faces add. The approach is sought without gradient, then evaluated with it.
    """
    eta = 0.25 * span

    def least(a, b, s):
        gaps, rates = jax.vmap(lambda t: _motion(a, b, t, live)[:2])(jnp.stack([s - eta, s, s + eta]))
        chosen = jax.nn.one_hot(jnp.argmin(gaps[1], 0), gaps.shape[1], axis=0, dtype=s.dtype)
        before, now, after = (chosen[None] * rates).sum(1)
        return (chosen * gaps[1]).sum(0), now, safe_divide(after - before, 2.0 * eta)

    def towards(_, t):
        _, v, curvature = least(*lax.stop_gradient((a, b)), t)
        return jnp.clip(t - jnp.where(curvature > 0, safe_divide(v, curvature), 0.0), s - span, s + span)

    closest = checkpoint_name(lax.stop_gradient(lax.fori_loop(0, POLISH, towards, s)), FOUND)
    gap, v, curvature = least(a, b, closest)
    turns_back = curvature > 0
    gap_min = gap - 0.5 * safe_divide(v * v, jnp.where(turns_back, curvature, 0.0))
    return jnp.where(turns_back, softplus(gap_min, width), 0.0)
