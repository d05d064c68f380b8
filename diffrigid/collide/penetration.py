"""How deep the cores of two convex shapes are inside each other: minus the least translation that parts them.

Contacts say where two bodies touch, each corner and each crossing by itself, and which of them there are changes as the
bodies sink into each other. Their depth is one number, continuous in both poses: the largest separation of the cores
along any direction. Where they overlap it is along a normal of a face, or along the common perpendicular of two edges
that are both outermost along it.
Source: Gregorius, The separating axis test, GDC 2013.
"""

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.collide.contacts import FAR, Contacts, joined
from diffrigid.collide.convex import corners_of, flipped, slack_between
from diffrigid.collide.edges import Edges, crossing, edges_of
from diffrigid.gathers import rows
from diffrigid.numerics import dot, normalise
from diffrigid.shapes import edges, faces, radius
from diffrigid.so2 import perp
from diffrigid.so3 import cross


def core_separation(a, x_a: Array, q_a: Array, b, x_b: Array, q_b: Array) -> Contacts:
    """The contact of two cores, at least one of them with faces, along the direction of their largest separation.

    (1, ...). Its gap is minus the depth where they overlap, else positive and no more than their distance.
    """
    dim = len(x_a)
    corners_a, corners_b = corners_of(a, x_a, q_a), corners_of(b, x_b, q_b)
    batch = jnp.broadcast_shapes(corners_a.shape[2:], corners_b.shape[2:])  # a static may be that of all worlds
    corners_a, corners_b = (jnp.broadcast_to(some, some.shape[:2] + batch) for some in (corners_a, corners_b))
    parts = []
    if faces(b, dim):
        parts.append(_over_faces(corners_a, corners_b, faces(b, dim)))
    if faces(a, dim):
        parts.append(flipped(_over_faces(corners_b, corners_a, faces(a, dim))))
    if dim == 3 and edges(a, dim) and edges(b, dim):
        slack = slack_between(corners_a, radius(a), corners_b, radius(b))
        parts.append(_across_edges(edges_of(a, corners_a), edges_of(b, corners_b), slack))
    return _first(joined(*parts), jnp.argmax)


def _over_faces(corners: Array, own: Array, faces: tuple) -> Contacts:
    """The lowest of some corners (V, D, *batch) over each face of a shape, (F, ...); `own`: its corners."""

    def over(start: Array, *others: Array) -> Contacts:
        sides = [other - start for other in others]
        n = -perp(*sides) if len(sides) == 1 else cross(*sides)
        n = normalise(n, fallback=jnp.zeros_like(n))  # of a side without extent: says that nothing overlaps
        heights = jax.vmap(lambda p: dot(n, p - start))(corners)
        normals = jnp.broadcast_to(n[None], corners.shape)
        return _first(Contacts(gap=heights, normal=normals, point=corners), jnp.argmin)

    each = jax.vmap(over)(*(rows(own, index) for index in zip(*faces, strict=True)))
    return jax.tree.map(lambda leaf: leaf[:, 0], each)


def _across_edges(down: Edges, across: Edges, slack: Array) -> Contacts:
    """All pairs of edges, (E E, ...), -FAR apart where they are not both outermost along their common perpendicular."""
    down, across = Edges(*(leaf[:, :, None] for leaf in down)), Edges(*(leaf[:, None] for leaf in across))
    c = crossing(down, across, slack[None, None])
    outermost = c.cross & (c.lowest >= -slack[None, None])
    gap = jnp.where(outermost, c.distance, -FAR)
    normal, point = (jnp.moveaxis(leaf, 0, 2) for leaf in (c.normal, 0.5 * (c.on_a + c.on_b)))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), Contacts(gap=gap, normal=normal, point=point))


def _first(contacts: Contacts, index) -> Contacts:
    """The contact with the smallest or the largest gap, by `index` (argmin or argmax), (1, ...)."""
    gap = contacts.gap
    chosen = jax.nn.one_hot(index(lax.stop_gradient(gap), 0), len(gap), axis=0, dtype=gap.dtype)
    normal, point = ((chosen[:, None] * r).sum(0)[None] for r in (contacts.normal, contacts.point))
    return Contacts(gap=(chosen * gap).sum(0)[None], normal=normal, point=point)
