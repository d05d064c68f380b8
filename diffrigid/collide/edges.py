"""Crossing edges of two convex shapes in space: planks that lie across each other, and edges that meet.

The few pairs of edges that can touch are selected without gradient, and evaluated with it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid import so3
from diffrigid.collide.contacts import FAR, Contacts, size_of
from diffrigid.gathers import rows
from diffrigid.numerics import dot, norm, normalise, unit_vector
from diffrigid.shapes import Capsule, edge_apexes, edges, radius

CROSSINGS = 8  # at most: of two rectangles face to face
PARALLEL = 1e-3  # [rad] edges closer to parallel than this do not cross
DIP = 1e-2  # [-] of the smaller size: so little may a face dip into another, beside a corner that does
ALONG_CONTACT = 0.5  # cosine: contacts of convex bodies that touch have one normal, up to their penetration


class Edges(NamedTuple):
    """E edges in the world; their axis follows that of components, because XLA vectorises the last axis."""

    start: Array  # (3, E, *batch) [m]
    along: Array  # (3, E, *batch) [m] from start to end
    left: Array  # (3, E, *batch) [m] from start to a corner of the face on one side
    right: Array  # (3, E, *batch) [m] and of the face on the other


def crossing_edges(
    a, corners_a: Array, b, corners_b: Array, contacts: Contacts, separated: Array, slack: Array
) -> Contacts:
    """Contacts where edges cross, 1 to CROSSINGS of them; unused ones are FAR apart.

    Args:
        corners_a, corners_b: (V, 3, *batch) [m] in the world.
        contacts: those of the corners; where one touches, its normal is that of the crossings as well.
        separated: (*batch) bool: a corner shows that the bodies do not overlap.
    """
    edges_a, edges_b = edges_of(a, corners_a), edges_of(b, corners_b)
    size_a, size_b = edges_a.start.shape[1], edges_b.start.shape[1]
    down, across, margin = lax.stop_gradient((edges_a, edges_b, slack))
    down, across = Edges(*(leaf[:, :, None] for leaf in down)), Edges(*(leaf[:, None] for leaf in across))
    deepest = lax.stop_gradient(contacts.gap.min(0) + radius(a) + radius(b))
    order = _order(crossing(down, across, margin[None, None]), separated, margin[None, None], deepest[None, None])
    order = jnp.moveaxis(order.reshape(size_a * size_b, *slack.shape), 0, -1)
    count = (CROSSINGS, 2, 1)[isinstance(a, Capsule) + isinstance(b, Capsule)]
    nearest, index = lax.top_k(-order, count)
    # By number: in order of their distances they would change places within a step, and what is known of each be lost.
    number = jnp.where(nearest > -FAR, index, size_a * size_b)
    number, nearest, index = (jnp.moveaxis(leaf, -1, 0) for leaf in lax.sort((number, nearest, index)))

    def pick(of: Edges, row: Array) -> Edges:
        chosen = jax.nn.one_hot(row, of.start.shape[1], axis=0, dtype=of.start.dtype)
        return Edges(*((chosen[None] * leaf).sum(1) for leaf in of))

    def one(row):
        return crossing(pick(edges_a, row // size_b), pick(edges_b, row % size_b), slack)

    chosen = jax.vmap(one)(index)
    exists = nearest > -FAR
    if count > 1:  # two capsules have one normal where they cross, and ends that touch do not change it
        exists = exists & _along_contact(chosen, contacts, slack)
    gap = jnp.where(exists, chosen.distance - (radius(a) + radius(b))[None], FAR)
    shift = (radius(b) - radius(a))[None, None] * chosen.normal  # from between the cores to between the surfaces
    middle = 0.5 * (chosen.on_a + chosen.on_b + shift)
    return Contacts(gap=gap, normal=chosen.normal, point=middle, feature=number.astype(gap.dtype))


def edges_of(shape, corners: Array) -> Edges:
    """The edges of a shape whose corners are at (V, 3, *batch) [m]."""
    columns = *zip(*edges(shape, 3), strict=True), *zip(*edge_apexes(shape, 3), strict=True)
    start, end, left, right = (jnp.swapaxes(rows(corners, index), 0, 1) for index in columns)
    return Edges(start, end - start, left - start, right - start)


class Crossing(NamedTuple):
    """Two edges where they are closest: the normal is their common perpendicular, away from b."""

    distance: Array  # (*batch) [m] from the edge of b to that of a along the normal
    normal: Array  # (3, *batch)
    on_a: Array  # (3, *batch) [m]
    on_b: Array
    cross: Array  # (*batch) bool: they are not parallel
    within: Array  # (*batch) bool: both points are inside their edges
    lowest: Array  # (*batch) [m] how far a face beside an edge dips towards the other shape, negative


def crossing(a: Edges, b: Edges, slack: Array) -> Crossing:
    """Closest points of two lines, from 2 x 2 normal equations, and whether their shapes may touch there.

    They do if the faces beside both edges fall away from the normal (arcs that cross in the Gauss map), so that along
    it both edges are the extremes of their shapes.
    Source: Ericson, Real-Time Collision Detection, 5.1.9; Gregorius, The separating axis test, GDC 2013.
    """
    length_a, length_b, u_a, u_b = norm(a.along), norm(b.along), normalise(a.along), normalise(b.along)
    between, cosine = a.start - b.start, dot(u_a, u_b)
    ra, rb, det = dot(u_a, between), dot(u_b, between), 1.0 - cosine * cosine
    cross = det > PARALLEL**2
    det = jnp.where(cross, det, 1.0)
    s_a, s_b = (cosine * rb - ra) / det, (rb - cosine * ra) / det  # [m] from the starts
    within = cross & (s_a > 0) & (s_a < length_a) & (s_b > 0) & (s_b < length_b)
    on_a, on_b = a.start + s_a[None] * u_a, b.start + s_b[None] * u_b
    n = normalise(so3.cross(u_a, u_b), fallback=unit_vector(between, -1))
    sides = dot(n, a.left), dot(n, a.right), -dot(n, b.left), -dot(n, b.right)  # [m] all on one side of zero
    behind = sides[0] + sides[1] + sides[2] + sides[3]
    towards = jnp.where(jnp.abs(behind) > slack, behind, dot(n, on_a - on_b))  # two capsules have no faces
    sign = jnp.where(towards >= 0, 1.0, -1.0).astype(n.dtype)
    lowest = jnp.minimum(jnp.minimum(sign * sides[0], sign * sides[1]), jnp.minimum(sign * sides[2], sign * sides[3]))
    n = sign[None] * n
    return Crossing(dot(n, on_a - on_b), n, on_a, on_b, cross, within, lowest)


def are_outermost(c: Crossing, deepest: Array, slack: Array) -> Array:
    """Whether, along the normal, both edges of crossings are the extremes of their shapes, (E, E, *batch) bool.

    They are so but for a dip where one face comes down on another beside a corner or crossing that is inside by more:
    the one with the least gap, `deepest` [m].
    """
    dip = jnp.where(c.distance >= deepest, DIP * size_of(slack), slack)
    return c.lowest >= -dip


def _order(c: Crossing, separated: Array, slack: Array, deepest: Array) -> Array:
    """How far the edges of all crossings are from touching, (E, E, *batch) [m]; FAR if they cannot touch.

    A positive distance is that of two points of the bodies, so it is no less than theirs. A negative one is
    penetration only if nothing separates the bodies.
    """
    apart = c.distance > slack
    outermost = c.within & (c.lowest >= -slack)
    separated = separated | (outermost & apart).any((0, 1))
    deepest = jnp.minimum(deepest, jnp.where(outermost & ~apart, c.distance, jnp.inf).min((0, 1), keepdims=True))
    touches = are_outermost(c, deepest, slack) & ~separated[None, None]
    return jnp.where(c.within & (apart | touches), jnp.abs(c.distance), FAR)


def _along_contact(c: Crossing, contacts: Contacts, slack: Array) -> Array:
    """Whether each of K crossings is apart, or has about the contact normal of the two bodies.

    That is the normal of the deepest corner or, if none touches, of the nearest crossing that is not apart.
    """
    apart = c.distance > slack[None]

    def pick(index, normals):
        return (jax.nn.one_hot(index, len(normals), axis=0, dtype=slack.dtype)[:, None] * normals).sum(0)

    nearest = jnp.argmin(jnp.where(apart, jnp.inf, jnp.abs(c.distance)), 0)
    corner, crossing = pick(jnp.argmin(contacts.gap, 0), contacts.normal), pick(nearest, c.normal)
    normal = lax.stop_gradient(jnp.where((contacts.gap.min(0) <= slack)[None], corner, crossing))
    return apart | (jax.vmap(dot, in_axes=(0, None))(c.normal, normal) > ALONG_CONTACT)
