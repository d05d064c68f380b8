"""A rounded convex shape and the solid below a polyline, in 2D.

Contacts are those of every corner of the shape with every segment of the profile, and of every vertex of the profile
with the core of the shape. A corner over a segment has the distance of its line, so that bodies slide over vertices
as over one line. Beyond the end of a segment

    where it is beyond its neighbour's as well, over a convex vertex: the distance to the vertex is a contact
    else, over a neighbour that rises from it, or below both: the distance of its line, which leads into the valley
    else, above the line of the segment: it may get there within the step, but not touch there: ALERT
    else: there is nothing to meet

and a vertex of the profile counts where it is convex and the normal of the body lies between those of its segments.
"""

import functools

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.collide.contacts import ALERT, FAR, Contacts, in_world, joined, slack_of
from diffrigid.collide.distance import core_distance, reach
from diffrigid.numerics import dot, norm, normalise
from diffrigid.shapes import Disc, Profile, radius, vertices
from diffrigid.so2 import moment, perp
from diffrigid.state import rotations

STRAIGHT = 1e-4  # [-] 1 - cosine of two segments, below which a body moves along them as along one
TURN = 1e-9  # [rad] least turn of a convex vertex


def convex_profile(a, x_a: Array, q_a: Array, b: Profile, x_b: Array, q_b: Array) -> Contacts:
    """Contacts of every corner with every segment and, unless a is a disc, of every inner vertex of b with a."""
    so = rotations(2)
    slack, alert = _lengths(a)
    corners = jax.vmap(lambda p: so.unrotate(q_b, x_a + so.rotate(q_a, p) - x_b))(vertices(a, 2))
    parts = [jax.vmap(lambda p: _corner_contacts(b, p, radius(a), slack, alert))(corners)]
    parts[0] = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), parts[0])
    if not isinstance(a, Disc):

        def distance(p: Array, inward: Array) -> tuple[Array, Array]:
            p, inward = x_b + so.rotate(q_b, p), so.rotate(q_b, inward)
            gap, n = core_distance(a, so.unrotate(q_a, p - x_a), so.unrotate(q_a, inward), slack)
            return gap, so.unrotate(q_b, so.rotate(q_a, n))

        parts.append(_vertex_contacts(b, distance, radius(a), slack, alert))
    c = joined(*parts)
    return in_world(c, x_b, q_b)


def on_next_segments(a, b: Profile, rests: Array) -> Array:
    """Extend `rests` (K, *batch) of `convex_profile`: a resting corner also rests on segments in line with its own.

    So a body that slides or rolls from one segment to the next is held there as before, and does not strike it.
    """
    up = lax.stop_gradient(jax.vmap(perp)(_segments(b)[1]))
    count = len(vertices(a, 2)) * len(up)
    on = rests[:count].reshape(-1, len(up), *rests.shape[1:])
    mean = jax.vmap(normalise)(jnp.where(on[:, :, None], up[None], 0.0).sum(1))
    straight = (up[None] * mean[:, None]).sum(2) > 1.0 - STRAIGHT
    return jnp.concatenate([(on | straight).reshape(count, *rests.shape[1:]), rests[count:]])


def clearance(b: Profile, p: Array) -> Array:
    """Distance from a point (2, *batch) in the profile's axes to the solid, (*batch) [m]; 0 inside."""
    start, along, _, length = _segments(b)
    share = jax.vmap(dot)(along, p[None] - start)
    low, high = _beyond(share, length)
    off = jnp.maximum(jnp.maximum(low, high), 0.0)
    height = jax.vmap(dot)(jax.vmap(perp)(along), p[None] - start)
    return jnp.where(_inside(b, p), 0.0, jnp.sqrt(height**2 + off**2).min(0))


def _lengths(a) -> tuple[Array, Array]:
    """Slack, the distance within which features coincide, and the least gap by ALERT, (*batch) [m]."""
    size = lax.stop_gradient(reach(a, 2))
    return slack_of(size), ALERT * size


def _segments(b: Profile) -> tuple[Array, Array, Array, Array]:
    """Starts (S, 2, *batch), unit vectors along, ends, and lengths (S, *batch)."""
    start, end = b.points[:-1], b.points[1:]
    length = jax.vmap(norm)(end - start)
    return start, (end - start) / length[:, None], end, length


def _beyond(share: Array, length: Array) -> tuple[Array, Array]:
    """How far a point is beyond the start and the end of each segment, (S, *batch) [m]; -inf at the outer two ends."""
    nowhere = jnp.full_like(share[:1], -jnp.inf)
    before = jnp.concatenate([nowhere, -share[1:]])
    return before, jnp.concatenate([(share - length)[:-1], nowhere])


def _inside(b: Profile, p: Array) -> Array:
    """Whether a point (2, *batch) is below the polyline."""
    start, along, _, _ = _segments(b)
    height = jax.vmap(dot)(jax.vmap(perp)(along), p[None] - start)
    nowhere = jnp.full_like(height[:1], jnp.inf)
    x = b.points[1:-1, 0] + jnp.zeros_like(height[1:])
    over = (p[0][None] >= jnp.concatenate([-nowhere, x])) & (p[0][None] < jnp.concatenate([x, nowhere]))
    return (over & (height < 0)).any(0)


def _corner_contacts(b: Profile, p: Array, rounding: Array, slack: Array, alert: Array) -> Contacts:
    """Contacts of one corner with all segments, (S, ...), in the profile's axes."""
    start, along, end, length = _segments(b)
    up = jax.vmap(perp)(along)
    height, share = (jax.vmap(dot)(r, p[None] - start) for r in (up, along))
    before, after = _beyond(share, length)
    # `slack`: values that are computed twice may be rounded differently.
    over, below = jnp.maximum(before, after) <= slack[None], _below_valley(along, before, after)
    best = jnp.where((over | below) & (height < 0), height, -jnp.inf).max(0)
    deep = _inside(b, p)[None] & (over | below) & (height < 0) & (height >= (best - slack)[None])  # the least deep
    beside = functools.partial(_over_valley, along, before=before - slack[None], after=after - slack[None])
    touches = (over | beside(over)) & (height >= -slack[None]) | deep | beside(deep)
    next_before = jnp.concatenate([before[1:], jnp.full_like(before[:1], -jnp.inf)])
    at_vertex = (after > slack[None]) & (next_before > slack[None]) & (height > slack[None])
    near_end = jnp.where((before > after)[:, None], start, end)
    away = p[None] - jnp.where(at_vertex[:, None], end, near_end)
    distance, direction = jax.vmap(norm)(away), jax.vmap(normalise)(away)
    may_meet = ~over & (height > slack[None]) & ~((before > slack[None]) & _shifted(at_vertex))
    gap = jnp.where(at_vertex, distance - rounding[None], jnp.maximum(distance - rounding[None], alert[None]))
    gap = jnp.where(at_vertex | may_meet, gap, FAR)
    gap = jnp.where(touches, height - rounding[None], gap)
    normal = jnp.where((at_vertex | may_meet)[:, None] & ~touches[:, None], direction, up)
    return Contacts(gap=gap, normal=normal, point=p[None] - (rounding[None] + 0.5 * gap)[:, None] * normal)


def _over_valley(along: Array, over: Array, before: Array, after: Array) -> Array:
    """Whether a corner is over a neighbour that makes a valley with a segment, (S, *batch) bool.

    There the line of the segment continues below the neighbour: a corner that reaches it has reached the valley, even
    if it has fallen a little since it was last held, and one that is held in the valley falls past both lines. Not
    between segments in line, on both of which it rests at once (`on_next_segments`): it would be held by the line of
    the one as it falls past the other.
    """
    none = jnp.zeros_like(over[:1])
    rises, in_line = (jax.vmap(fn)(along[:-1], along[1:]) for fn in (_cross, dot))
    valley = jnp.concatenate([(rises > 0) & (in_line < 1.0 - STRAIGHT) & ~none, none])  # at its end
    over_next = jnp.concatenate([over[1:], none])
    return (_shifted(over & valley) & (after <= 0)) | (over_next & valley & (before <= 0))


def _below_valley(along: Array, before: Array, after: Array) -> Array:
    """Whether a corner is beyond the ends of both segments of a valley, below its vertex, (S, *batch) bool."""
    below = (jax.vmap(_cross)(along[:-1], along[1:]) > 0) & (after[:-1] > 0) & (before[1:] > 0)
    before_vertex = jnp.concatenate([below, jnp.zeros_like(below[:1])])
    return before_vertex | _shifted(before_vertex)


def _shifted(flags: Array) -> Array:
    """Shift flags by one: each segment gets that of the one before."""
    return jnp.concatenate([jnp.zeros_like(flags[:1]), flags[:-1]])


def _vertex_contacts(b: Profile, distance_of, rounding: Array, slack: Array, alert: Array) -> Contacts:
    """Contacts of the inner vertices with the core of a body, (S - 1, ...), in the profile's axes."""
    _, along, _, length = _segments(b)
    up = jax.vmap(perp)(along)

    def one(p, along_0, along_1, up_0, up_1, size):
        inward = lax.stop_gradient(-size[None] * (up_0 + up_1))
        distance, n = distance_of(p + jnp.zeros_like(inward), inward)
        gap = distance - rounding
        convex = _cross(along_0, along_1) < -TURN
        between = (_cross(up_0, -n) <= TURN) & (_cross(-n, up_1) <= TURN) & (dot(-n, up_0 + up_1) > 0)
        far = jnp.where(convex & (distance > slack), jnp.maximum(gap, alert), FAR)
        gap = jnp.where(convex & between, gap, far)
        return Contacts(gap=gap, normal=-n, point=p - 0.5 * gap[None] * n)

    return jax.vmap(one)(b.points[1:-1], along[:-1], along[1:], up[:-1], up[1:], length[1:])


def _cross(a: Array, b: Array) -> Array:
    return moment(a, b)[0]
