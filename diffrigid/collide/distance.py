"""Signed distance from the core of a convex shape to a corner of another body, in the shape's own axes.

Each function takes a shape, a point p (D, *batch) [m], which is a corner of another body, and `inward`
(D, *batch) [m], from p to the middle of that body. It returns `(distance, normal)`: (*batch) [m], negative inside,
and the unit vector from the shape to the point, (D, *batch). On a face the distance is that to its plane and the
normal is constant: both are smooth through zero. Beyond a corner or an edge it is Euclidean, |p - closest|.

Where p is at two faces at once, `inward` decides which counts: a body that lies on a face is all in front of
it. So corner on corner, as in a stack of equal boxes, the normal is that of the face between the two bodies
and not one of rounding. `slack` (*batch) [m] is the distance within which p is at a face, an edge or a corner.
"""

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.collide.contacts import ALERT, size_of
from diffrigid.gathers import first_highest, rows
from diffrigid.numerics import dot, norm, normalise, unit_vector
from diffrigid.shapes import Box, Capsule, Disc, Hull, Polygon, Sphere, radius, vertices
from diffrigid.so2 import perp
from diffrigid.so3 import cross


def point_distance(shape, p: Array, inward: Array, slack: Array) -> tuple[Array, Array]:
    """Distance from the centre of a disc or sphere."""
    del shape, inward
    return _away(p, unit_vector(p, -1), slack)


def segment_distance(shape: Capsule, p: Array, inward: Array, slack: Array) -> tuple[Array, Array]:
    """Distance from the axis of a capsule, which lies along x; on the axis of a thin rod, its two sides."""
    h = shape.half_length[None]
    along = jnp.concatenate([jnp.clip(p[:1], -h, h), jnp.zeros_like(p[1:])])
    across = jnp.concatenate([jnp.zeros_like(p[:1]), inward[1:]])
    return _away(p - along, normalise(across, fallback=unit_vector(p, -1)), slack)


def _away(r: Array, side: Array, slack: Array) -> tuple[Array, Array]:
    """Length and direction of r; within `slack`, where the direction is rounding, height over the `side`."""
    length = norm(r)
    far = length > slack
    normal = jnp.where(far[None], r / jnp.where(far, length, 1.0)[None], side)
    return jnp.where(far, length, dot(side, r)), normal


def box_distance(shape: Box, p: Array, inward: Array, slack: Array) -> tuple[Array, Array]:
    """Distance from a box: the largest of |p_i| - half_i on a face, Euclidean beyond edges and corners."""
    side = jnp.where(jnp.where(jnp.abs(p) > slack[None], p, inward) >= 0, 1.0, -1.0).astype(p.dtype)
    excess = side * p - shape.half
    reachable = lax.stop_gradient(_reachable(excess, side * inward, slack))
    face = jnp.stack(first_highest(list(reachable))).astype(p.dtype)
    beyond = (excess > slack[None]).sum(0) > 1
    outside = jnp.where(beyond[None], jnp.maximum(excess, 0.0), face)
    distance = jnp.where(beyond, norm(outside), dot(face, excess))
    at = (jnp.abs(excess) <= slack[None]) & (side * inward > 0)
    return _alerted(distance, at, (at | (excess > slack[None])).sum(0) > 1, slack), side * normalise(outside)


def polygon_distance(shape: Polygon, p: Array, inward: Array, slack: Array) -> tuple[Array, Array]:
    """Distance from a convex polygon: the edge whose line is farthest below p holds the closest point."""
    start = shape.vertices
    edge = jnp.roll(start, -1, axis=0) - start
    length = jax.vmap(norm)(edge)
    along = edge / length[:, None]
    outward = -jax.vmap(perp)(along)
    dots = jax.vmap(dot, in_axes=(0, None))
    height, facing = jax.vmap(dot)(outward, p[None] - start), dots(outward, inward)
    best = jnp.argmax(_reachable(height, facing, slack), axis=0)
    chosen = jax.nn.one_hot(best, height.shape[0], axis=0, dtype=p.dtype)
    n, distance = (chosen[:, None] * outward).sum(0), (chosen * height).sum(0)
    r = p - (chosen[:, None] * start).sum(0)
    share, end = dot((chosen[:, None] * along).sum(0), r), (chosen * length).sum(0)
    beyond = ((share < -slack) | (share > end + slack)) & (distance > 0)
    corner = r - jnp.where(share > 0.5 * end, 1.0, 0.0).astype(p.dtype)[None] * (chosen[:, None] * edge).sum(0)
    away = jnp.where(beyond[None], corner, n)
    at = (jnp.abs(height) <= slack[None]) & (facing > 0)
    several = (at | (height > slack[None])).sum(0) > 1
    return _alerted(jnp.where(beyond, norm(away), distance), at, several, slack), normalise(away)


def hull_distance(shape: Hull, p: Array, inward: Array, slack: Array) -> tuple[Array, Array]:
    """Distance from a convex hull: inside, the least deep face; outside, the closest of its triangles."""
    a, b, c = (rows(shape.vertices, index) for index in zip(*(shape.faces or ()), strict=True))
    outward = jax.vmap(normalise)(jax.vmap(cross)(b - a, c - a))
    height = jax.vmap(dot)(outward, p[None] - a)
    facing = jax.vmap(dot, in_axes=(0, None))(outward, inward)
    reachable = _reachable(height, facing, slack)
    closest, on_face = jax.vmap(_triangle, in_axes=(0, 0, 0, 0, 0, None, None))(a, b, c, outward, height, p, slack)
    square = jax.vmap(lambda r: dot(r, r))(p[None] - closest)
    square = square + jnp.where(facing < -slack[None], slack * slack, 0.0)  # at an edge, not the face from behind
    inside = reachable.max(0) <= 0
    best = jnp.where(inside, jnp.argmax(reachable, axis=0), jnp.argmin(square, axis=0))
    chosen = jax.nn.one_hot(best, height.shape[0], axis=0, dtype=p.dtype)
    beyond = ~inside & ~((chosen > 0) & on_face).any(0)
    corner = p - (chosen[:, None] * closest).sum(0)
    away = jnp.where(beyond[None], corner, (chosen[:, None] * outward).sum(0))
    at = (jnp.abs(height) <= slack[None]) & (facing > 0)
    planes = norm(lax.stop_gradient(jnp.where(at[:, None], outward, 0.0).sum(0)))  # less than their number, if several
    several = (height > slack[None]).any(0) | (planes < at.sum(0).astype(p.dtype) - 1e-6)
    return _alerted(jnp.where(beyond, norm(away), (chosen * height).sum(0)), at, several, slack), normalise(away)


def _triangle(a: Array, b: Array, c: Array, n: Array, height: Array, p: Array, slack: Array):
    """The point of a triangle closest to p, (3, *batch), and whether p is over it to within `slack`."""
    ends = ((a, b), (b, c), (c, a))
    inner = [dot(normalise(cross(n, end - start)), p - start) for start, end in ends]
    over = (inner[0] >= -slack) & (inner[1] >= -slack) & (inner[2] >= -slack)
    on_edges = jnp.stack([closest_on_segment(start, end, p) for start, end in ends])
    square = jax.vmap(lambda r: dot(r, r))(p[None] - on_edges)
    nearest = jax.nn.one_hot(jnp.argmin(square, axis=0), 3, axis=0, dtype=p.dtype)
    return jnp.where(over[None], p - height[None] * n, (nearest[:, None] * on_edges).sum(0)), over


def closest_on_segment(start: Array, end: Array, p: Array) -> Array:
    """Point of the segment from start to end that is closest to p, (D, *batch)."""
    along = end - start
    share = jnp.clip(dot(p - start, along) / dot(along, along), 0.0, 1.0)
    return start + share[None] * along


def _alerted(distance: Array, at: Array, several: Array, slack: Array) -> Array:
    """Distance, no less than ALERT at a corner that slides along the plane of a face, until it is over that face.

    It comes to lie on the face, and does not strike the one around the corner.

    Args:
        at: (F, *batch) bool: faces in whose plane it is, with its body in front of them.
        several: (*batch) bool: it is also outside another face, or in the planes of several.
    """
    alert = ALERT * size_of(slack)
    return jnp.where(at.any(0) & several, jnp.maximum(distance, lax.stop_gradient(alert)), distance)


def _reachable(height: Array, facing: Array, slack: Array) -> Array:
    """Heights over the faces, (F, *batch) [m], -inf where a body of which p is a corner cannot lie.

    Args:
        facing: (F, *batch) [m] how far in front of the face the middle of the body is, seen from p.
    """
    possible = (facing >= -slack[None]) | (height > slack[None])
    return jnp.where(possible | ~possible.any(0)[None], height, -jnp.inf)


DISTANCES = {
    Disc: point_distance,
    Sphere: point_distance,
    Capsule: segment_distance,
    Box: box_distance,
    Polygon: polygon_distance,
    Hull: hull_distance,
}


def core_distance(shape, p: Array, inward: Array, slack: Array) -> tuple[Array, Array]:
    """Signed distance and normal of any shape's core; see the module's docstring."""
    return DISTANCES[type(shape)](shape, p, inward, slack)


def reach(shape, dim: int) -> Array:
    """Radius about the shape's origin that encloses it, (*batch) [m]."""
    corners = vertices(shape, dim)
    return jax.vmap(norm)(corners).max(0) + radius(shape)
