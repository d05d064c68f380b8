"""When two colliders meet within a step, on their true paths, and where.

The time is found without derivatives, by a closed form for round shapes and a search for the rest, and then
given the derivative of the implicit function theorem (`implicit_root`). Everything else, normal, arms and
speeds, is evaluated *at* that time, and so follows it.

Smoothing is put into the distance, not into time: with `width` > 0 an impact happens at the distance

    level = width * softplus(gap_min / width),     gap_min: closest approach of the predicted paths

which is Newton's law at a slightly larger distance: it keeps momentum, makes no energy, leaves full hits
(gap_min far below zero) as they are, and lets a near miss pull.
"""

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.collide.heights import height_over, unseen_for
from diffrigid.contact.order import Meeting
from diffrigid.contact.sides import (
    Placed,
    Side,
    candidates_of,
    centre,
    contacts_of,
    gap_rates,
    place,
    reach_of,
    relative_acceleration,
)
from diffrigid.numerics import (
    FOUND,
    MANY,
    apart,
    dot,
    fold,
    implicit_root,
    norm,
    normalise,
    opaque_true,
    safe_divide,
    safe_sqrt,
    softplus,
    some,
)
from diffrigid.shapes import Disc, HalfSpace, HeightField, Shape, Sphere, radius, vertices
from diffrigid.state import rotations

CROSSED = 3  # advances for each node along a side of a grid: the length of its diagonal in half cells
ADVANCES = 48  # conservative advances at most, each at least the gap over a bound on the closing speed
POLISH = 6  # steps along the local parabola of the gap; error squared by each
ROUNDING = 1e5  # [-] of the last digit of NEAR: how far rounding of their places may hold bodies apart
NEAR = 1e-3  # [-] fraction of the smaller reach at which advancing hands over to polishing


def find_impact(
    a: Side, b: Side, t1: Array, width: Array | None, straight: bool, rest_speed: Array, at_end: Array
) -> Meeting:
    """First impact of one pair before t1, or the end of the step itself.

    Args:
        t1: (*batch) [s] end of the step.
        width: (*batch) [m] of the smooth distance; 0 is exact. None: exact, known when tracing.
        straight: all bodies have the same acceleration, so relative paths are straight lines.
        rest_speed: (*batch) [m/s] slower impacts do not move their time with the parameters.
        at_end: bool; True: do not look for an impact, s is t1.

    Differentiable except where an impact appears or vanishes (grazing), which is a kink for width = 0.
    """
    live, begin = opaque_true(t1), _earliest(a, b)[0]
    varying = any(side.flight is not None and side.flight.jerk is not None for side in (a, b))
    if closed_form(a.shape, b.shape, straight) and not varying:
        s0, level, found, _ = apart(live, approach, a, b, width)
        rests = _round_rests(*lax.stop_gradient((a, b, begin, rest_speed)))[None]
    else:
        s0, level, found, rests = _approach_search(a, b, t1, width, rest_speed, at_end)
    hit = found & (s0 <= t1) & ~at_end
    s0 = lax.stop_gradient(jnp.where(hit, s0, t1))
    s0, hit = checkpoint_name((s0, hit), FOUND)
    slack = jnp.sqrt(jnp.finfo(s0.dtype).eps) * jnp.minimum(reach_of(a), reach_of(b))
    at_a, at_b = place(a, s0, live), place(b, s0, live)
    moved = contacts_of(a, at_a, b, at_b)
    gap, speed = lax.stop_gradient((moved.gap, gap_rates(moved, at_a, at_b)))
    closing = (gap <= (lax.stop_gradient(level) + slack)[None]) & (speed < -rest_speed[None]) & hit[None]
    share = closing.astype(s0.dtype) / jnp.maximum(closing.sum(0), 1)[None].astype(s0.dtype)
    s = implicit_root(s0, (share * moved.gap).sum(0) - level, (share * speed).sum(0))
    # What is already inside where the paths begin is struck there, whatever its gap.
    at_once = jnp.any(closing & (gap < lax.stop_gradient(level - slack)[None]), 0) & (s0 <= begin)
    s = jnp.where(at_once, begin, s)
    s = jnp.where(at_end, t1, s)  # moves with the length of the step
    # Which of the many places of a grid rest is not what the contacts are numbered by.
    rests = rests if len(rests) == len(gap) else jnp.broadcast_to(rests.any(0), gap.shape)
    return Meeting(s=s, hit=hit | at_end, fast=closing.any(0), rests=rests & ~at_end, level=level, slack=slack)


def _round_rests(a: Side, b: Side, start: Array, rest_speed: Array) -> Array:
    """Whether two round shapes, or one and a half-space, touch at the start and stay together, (*batch) bool."""
    (x_a, v_a), (x_b, v_b) = centre(a, start), centre(b, start)
    if isinstance(b.shape, HalfSpace):
        n = rotations(a.flight.dim).rotate(b.q, b.shape.normal)
        gap, acc = dot(n, x_a - x_b) - b.shape.offset - a.shape.radius, dot(n, a.flight.a)
    else:
        n = normalise(x_a - x_b)
        gap, acc = norm(x_a - x_b) - a.shape.radius - b.shape.radius, jnp.zeros_like(start)
    return _touches(gap, dot(n, v_a - v_b), acc, NEAR * jnp.minimum(reach_of(a), reach_of(b)), rest_speed)


def _touches(gap: Array, v: Array, acc: Array, near: Array, slow: Array) -> Array:
    """Whether a gap is closed, or about to close, no faster than `slow` [m/s]; rounding does not keep it open."""
    open_by = jnp.maximum(gap - ROUNDING * jnp.finfo(gap.dtype).eps * near, 0.0)
    return (gap <= near) & (v * v + 2.0 * open_by * jnp.abs(acc) <= slow**2)


def approach(a: Side, b: Side, width: Array | None) -> tuple[Array, Array, Array, Array]:
    """Where it has a closed form: time of the impact (no gradient), level of the gap, whether there is one, speed."""
    return _approach_parabola(a, b, width) if isinstance(b.shape, HalfSpace) else _approach_straight(a, b, width)


def closed_form(a: Shape, b: Shape, straight: bool) -> bool:
    """Whether the impact time of two shapes has a closed form, where all bodies fall alike (`straight`) or not."""
    return isinstance(a, Disc | Sphere) and (isinstance(b, HalfSpace) or (isinstance(b, Disc | Sphere) and straight))


def _earliest(a: Side, b: Side) -> tuple[Array, Array]:
    """Time from which both paths hold, and how far back a late impact may be repaired."""
    start = began(a, b)
    if b.flight is None or a.flight is None:
        return start, (a if b.flight is None else b).since
    return start, jnp.maximum(a.since, b.since)


def began(a: Side, b: Side) -> Array:
    """Time from which both paths hold, (*batch) [s]."""
    if b.flight is None or a.flight is None:
        return (a if b.flight is None else b).flight.t0
    return jnp.maximum(a.flight.t0, b.flight.t0)


def _approach_straight(a: Side, b: Side, width: Array | None) -> tuple[Array, Array, Array, Array]:
    start, bound = _earliest(a, b)
    (x_a, v_a), (x_b, v_b) = centre(a, start), centre(b, start)
    s, level, found, speed = meet_on_line(x_a - x_b, v_a - v_b, a.shape.radius + b.shape.radius, width)
    s = start + s
    return jnp.where(s < bound, start, s), level, found, speed


def meet_on_line(P: Array, W: Array, R: Array, width: Array | None) -> tuple[Array, Array, Array, Array]:
    """Two round shapes whose relative path is a line: |P + W s| = R + level.

    With D = (P.W)^2 - W^2 (P^2 - R^2), smooth: D -> eps softplus(D / eps), eps = 2 R W^2 width, and the
    distance at impact is the Rs >= R that this D belongs to.

    Args:
        P, W: (D, *batch) [m], [m/s] of a against b at time 0.
        R: (*batch) [m] sum of the radii.
        width: None is exact.

    Returns:
        s [s], level [m], whether they meet (bool), closing speed then [m/s]; (*batch).
    """
    W2, closing, excess = dot(W, W), -dot(P, W), dot(P, P) - R * R
    D_exact = closing * closing - W2 * excess

    if width is None:
        D, raised, level = D_exact, jnp.zeros_like(D_exact), jnp.zeros_like(D_exact)
    else:
        D = _if_smooth(width, lambda D: softplus(D, 2.0 * R * W2 * width), lambda D: jnp.maximum(D, 0.0), D_exact)
        raised = safe_divide(D - D_exact, W2)
        level = safe_sqrt(R * R + raised) - R
    root = safe_sqrt(D)
    s = safe_divide(excess - raised, closing + root)
    return s, level, (closing > 0) & (D > 0), root / (R + level)


def _if_smooth(width: Array | None, smooth, exact, *args: Array) -> Array:
    """smooth(*args) if any width is positive, else exact(*args)."""
    return exact(*args) if width is None else lax.cond(some(width > 0), smooth, exact, *args)


def _approach_parabola(a: Side, b: Side, width: Array | None) -> tuple[Array, Array, Array, Array]:
    so, (start, bound) = rotations(a.flight.dim), _earliest(a, b)
    normal = so.rotate(b.q, b.shape.normal)
    x, velocity = centre(a, start)
    gap = dot(normal, x - b.x) - b.shape.offset - a.shape.radius
    s, level, found, root, sunk = meet_on_parabola(gap, dot(normal, velocity), dot(normal, a.flight.a), width)
    s = start + s
    return jnp.where(sunk | (s < bound), start, s), level, found, root


def meet_on_parabola(gap: Array, v: Array, acc: Array | None, width: Array | None):
    """A round shape and a half-space at rest: gap(s) = gap + v s + acc s^2 / 2, exactly; all (*batch).

    Args:
        acc: None where nothing accelerates.

    Returns:
        s, level, whether they meet and closing speed as `meet_on_line`; whether it is inside and sinks, with no
        crossing in the past: then the impact is at once.
    """
    if acc is None:
        return safe_divide(gap, -v), jnp.zeros_like(gap), v < 0, -v, False
    turns_back = acc > 0
    gap_min = gap - 0.5 * safe_divide(v * v, jnp.where(turns_back, acc, 0.0))

    def smooth(gap_min):
        return jnp.where(turns_back, softplus(gap_min, width), 0.0)

    level = _if_smooth(width, smooth, jnp.zeros_like, gap_min)
    height = gap - level
    root = safe_sqrt(v * v - 2.0 * acc * height)
    up = v > 0  # then the impact is on the way down
    s = safe_divide(jnp.where(up, v + root, 2.0 * height), jnp.where(up, -acc, root - v))
    # Below the surface and sinking, with no crossing in the past: the impact is now.
    sunk = (height < 0) & (v * v < 2.0 * acc * height)
    found = jnp.where(turns_back, (v < 0) & (root > 0), (v < 0) | (acc < 0)) | sunk
    return s, level, found, root, sunk


def _approach_search(
    a: Side, b: Side, t1: Array, width: Array | None, rest_speed: Array, at_end: Array
) -> tuple[Array, Array, Array, Array]:
    """Any two shapes: conservative advancement to the neighbourhood, then the parabola of the next contact.

    Nothing is looked for `at_end`, a bool.
    """
    start, bound = _earliest(a, b)
    frozen_a, frozen_b = lax.stop_gradient((a, b))
    size = jnp.minimum(reach_of(a), reach_of(b))
    near, rests = _advance(frozen_a, frozen_b, start, t1, size, lax.stop_gradient(rest_speed), at_end)
    near, rests = checkpoint_name((near, rests), FOUND)
    live = opaque_true(t1)

    def smooth(near):
        return _closest_level(a, b, near, t1 - start, width, live)  # type: ignore[arg-type]

    level = _if_smooth(width, smooth, jnp.zeros_like, near)
    s, found = _polish(frozen_a, frozen_b, near, lax.stop_gradient(level), size, start, t1, rests, at_end, live)
    return jnp.where(s < bound, start, s), level, found, rests


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
    r = vertices(a.shape, dim)
    r = r if a.offset is None else r + a.offset[None]
    turning = so.cross(at.w, normal)
    axes = [normal, -turning, so.cross(at.w, turning) - so.cross(at.dw, normal)]
    heights = [dot(normal, at.x - b.x) - b.shape.offset - radius(a.shape), dot(normal, at.v), dot(normal, at.a)]
    height, rate, acceleration = (
        h[None] + jax.vmap(dot, (None, 0))(so.unrotate(at.q, n), r) for h, n in zip(heights, axes, strict=True)
    )
    return height, rate, acceleration


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

    Those touch, or are about to, no faster than `slow` [m/s], or beside such a one no faster than would rest anyway.
    They are left out: in a flight without support they would be the next to close, and hide the fast impact of another.

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
        return ~at_end & ((count == 0) | ((count < most) & some((dt > 0) & (s < t1))))

    def advance(carry):
        count, s, dt, rests = carry
        onward = jnp.where(s < t1, jnp.minimum(s + jnp.maximum(dt, 0.0), t1), s)
        gap, v, acc, normal = _motion(a, b, onward, live)
        touches = _touches(gap, v, acc, near[None], slow[None])
        # Beside one that rests, what closes by a third of its fall: it would be back within the step, whatever e <= 1.
        least = slow[None] + jnp.maximum(-acc, 0.0) * span[None] / 3.0
        beside = _touches(gap, v, acc, near[None], least) & touches.any(0)[None]
        rests = jnp.where(count == 0, touches | beside, rests)
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
        return ~at_end & (count <= POLISH) & some(jnp.abs(dt) > slack * span)

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

    _, s, _, found, inside = lax.while_loop(busy, towards, (0, s, jnp.inf + s, s < s, s < s))
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
