"""Time and place at which two colliders meet within a step, on their true paths.

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

from diffrigid.collide.contacts import transferred
from diffrigid.collide.heights import of_nearest
from diffrigid.collide.profile import on_next_segments
from diffrigid.contact.approach import if_smooth, touches
from diffrigid.contact.gaps import NEAR, at_corners
from diffrigid.contact.held_up import held_up
from diffrigid.contact.levers import with_rates
from diffrigid.contact.order import Meeting
from diffrigid.contact.search import approach_search
from diffrigid.contact.sides import (
    Side,
    centre,
    contacts_of,
    earliest,
    gap_rates,
    gap_rounding,
    is_ball,
    moving_along,
    place,
    reach_of,
    smaller_size,
)
from diffrigid.fence import unfused
from diffrigid.numerics import FOUND, dot, implicit_root, norm, normalise, safe_divide, safe_sqrt, softplus
from diffrigid.shapes import HalfSpace, HeightField, Profile
from diffrigid.state import rotations

AT_ONCE = 1e-8  # [-] of the smaller size: contacts whose gaps differ by no more, or by their rounding, strike at once


def find_impact(
    a: Side, b: Side, t1: Array, width: Array | None, straight: bool, rest_speed: Array, rested: Array, at_end: Array
) -> Meeting:
    """First impact of one pair before t1, or the end of the step itself.

    Args:
        t1: (*batch) [s] end of the step.
        width: (*batch) [m] smoothing width of the distance; 0 is exact. None: exact, known when tracing.
        straight: all bodies have the same acceleration, so relative paths are straight lines.
        rest_speed: (*batch) [m/s] the times of slower impacts have no derivative.
        rested: (*batch) bool: a contact of the two rested before, in this step.
        at_end: bool; True: do not look for an impact, s is t1.

    Differentiable except where an impact appears or vanishes (grazing), which is a kink for width = 0.
    """
    begin = earliest(a, b)[0]
    varying = any(side.flight is not None and side.flight.jerk is not None for side in (a, b))
    if closed_form(a, b, straight) and not varying:
        s0, level, found, _ = unfused(approach, a, b, width)
        rests, feature = round_rests(*lax.stop_gradient((a, b, begin, rest_speed)))[None], None
    else:
        s0, level, found, rests, feature = approach_search(a, b, t1, width, rest_speed, rested, at_end)
    hit = found & (s0 <= t1) & ~at_end
    s0 = lax.stop_gradient(jnp.where(hit, s0, t1))
    s0, hit = checkpoint_name((s0, hit), FOUND)
    at_a, at_b = place(a, s0), place(b, s0)
    slack = jnp.maximum(AT_ONCE * smaller_size(a, b), gap_rounding(a, at_a, b, at_b))
    up = held_up(a, at_a, b, at_b, s0)
    at_a, at_b = up.at_a, up.at_b
    if up.way is None:
        contacts, turning = contacts_of(a, at_a, b, at_b), 0.0
    else:
        contacts, moving = with_rates(a, at_a, b, at_b)
        turning = jax.vmap(dot, (0, None))(moving.normal, up.way)  # in the rates of the gaps, as normals turn
    gaps, rests = up.gaps(contacts), transferred(rests, feature, contacts.feature)
    gap, speed = lax.stop_gradient((gaps, gap_rates(contacts, at_a, at_b)))
    closes = (gap <= (lax.stop_gradient(level) + slack)[None]) & (speed < -rest_speed[None]) & hit[None]
    if len(rests) == len(gap) == 1:  # as it falls, a resting contact would always be next, and hide others
        closes = closes & ~rests
    # A contact that rested has sunk below its level meanwhile; it does not affect when the others reach theirs.
    there = closes & (gap >= (lax.stop_gradient(level) - slack)[None])
    struck = jnp.where(there.any(0)[None], there, closes).astype(s0.dtype)
    share = struck / jnp.maximum(struck.sum(0), 1.0)[None]
    along = moving_along(a, at_a, s0), moving_along(b, at_b, s0)
    # For derivatives only: a rollout is spared it.
    slope = lax.stop_gradient(share * (gap_rates(contacts, *along) + turning)).sum(0)
    s = implicit_root(s0, (share * gaps).sum(0) - level, slope)
    # A contact that is inside where the paths begin is struck there, whatever its gap; one that turns round inside, and
    # closes again, where it is found (exact impacts only): neither is where a gap vanishes.
    inside = closes & (gap < lax.stop_gradient(level - slack)[None])
    s = jnp.where(inside.any(0) & ~there.any(0), jnp.where(s0 < t1, s0, t1), s)
    s = jnp.where(inside.any(0) & (s0 <= begin), begin, s)
    s = jnp.where(at_end, t1, s)  # moves with the length of the step
    if len(rests) != len(gap):  # contacts are a selection: of the corners of a box, or of places on a grid
        on_grid = isinstance(b.shape, HeightField)
        rests = of_nearest(a.shape, b.shape, rests, len(gap)) if on_grid else at_corners(a, at_a, contacts, rests)
    elif isinstance(b.shape, Profile):
        rests = on_next_segments(a.shape, b.shape, rests)
    return Meeting(
        s=s, hit=hit | at_end, fast=closes.any(0), rests=rests & ~at_end, feature=contacts.feature, level=level,
        slack=slack,
    )  # fmt: skip


def round_rests(a: Side, b: Side, start: Array, rest_speed: Array) -> Array:
    """Whether two round shapes, or one and a half-space, touch at the start and stay together, (*batch) bool."""
    (x_a, v_a), (x_b, v_b) = centre(a, start), centre(b, start)
    if isinstance(b.shape, HalfSpace):
        n = rotations(a.flight.dim).rotate(b.q, b.shape.normal)
        gap, acc = dot(n, x_a - x_b) - b.shape.offset - a.shape.radius, dot(n, a.flight.a)
    else:
        n = normalise(x_a - x_b)
        gap, acc = norm(x_a - x_b) - a.shape.radius - b.shape.radius, jnp.zeros_like(start)
    return touches(gap, dot(n, v_a - v_b), acc, NEAR * jnp.minimum(reach_of(a), reach_of(b)), rest_speed)


def approach(a: Side, b: Side, width: Array | None) -> tuple[Array, Array, Array, Array]:
    """Impact in closed form: its time (no gradient), level of the gap, whether there is one, closing speed."""
    return _approach_parabola(a, b, width) if isinstance(b.shape, HalfSpace) else _approach_straight(a, b, width)


def closed_form(a: Side, b: Side, straight: bool) -> bool:
    """Whether the impact time of two colliders has a closed form; `straight`: relative paths are straight lines."""
    return is_ball(a) and (isinstance(b.shape, HalfSpace) or (is_ball(b) and straight))


def _approach_straight(a: Side, b: Side, width: Array | None) -> tuple[Array, Array, Array, Array]:
    start, bound = earliest(a, b)
    (x_a, v_a), (x_b, v_b) = centre(a, start), centre(b, start)
    s, level, found, speed = meet_on_line(x_a - x_b, v_a - v_b, a.shape.radius + b.shape.radius, width)
    s = start + s
    return jnp.where(s < bound, start, s), level, found, speed


def meet_on_line(x: Array, v: Array, R: Array, width: Array | None) -> tuple[Array, Array, Array, Array]:
    """Two round shapes whose relative path is a line: |x + v s| = R + level.

    With D = (x.v)^2 - v^2 (x^2 - R^2), smooth: D -> eps softplus(D / eps), eps = 2 R v^2 width, and the
    distance at impact is the Rs >= R that this D belongs to.

    Args:
        x, v: (D, *batch) [m], [m/s] of a against b at time 0.
        R: (*batch) [m] sum of the radii.
        width: None is exact.

    Returns:
        s [s], level [m], whether they meet (bool), closing speed then [m/s]; (*batch).
    """
    v2, towards, excess = dot(v, v), -dot(x, v), dot(x, x) - R * R
    D_exact = towards * towards - v2 * excess

    if width is None:
        D, raised, level = D_exact, jnp.zeros_like(D_exact), jnp.zeros_like(D_exact)
    else:
        D = if_smooth(width, lambda D: softplus(D, 2.0 * R * v2 * width), lambda D: jnp.maximum(D, 0.0), D_exact)
        raised = safe_divide(D - D_exact, v2)
        level = safe_sqrt(R * R + raised) - R
    root = safe_sqrt(D)
    s = safe_divide(excess - raised, towards + root)
    return s, level, (towards > 0) & (D > 0), root / (R + level)


def _approach_parabola(a: Side, b: Side, width: Array | None) -> tuple[Array, Array, Array, Array]:
    so, (start, bound) = rotations(a.flight.dim), earliest(a, b)
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

    level = if_smooth(width, smooth, jnp.zeros_like, gap_min)
    height = gap - level
    root = safe_sqrt(v * v - 2.0 * acc * height)
    up = v > 0  # then the impact is on the way down
    s = safe_divide(jnp.where(up, v + root, 2.0 * height), jnp.where(up, -acc, root - v))
    # Below the surface and sinking, with no crossing in the past: the impact is now.
    sunk = (height < 0) & (v * v < 2.0 * acc * height)
    found = jnp.where(turns_back, (v < 0) & (root > 0), (v < 0) | (acc < 0)) | sunk
    return s, level, found, root, sunk
