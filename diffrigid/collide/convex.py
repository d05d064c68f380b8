"""Two rounded convex shapes: every vertex of each against the other and, in space, the edges that cross.

Two convex cores touch first at a vertex of one of them, or, in three dimensions, where two edges cross. A
face that lands flat touches with all its vertices and crossings, and each is a contact.
"""

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.collide.contacts import FAR, Contacts, joined, slack_of
from diffrigid.collide.distance import core_distance
from diffrigid.collide.edges import crossing_edges
from diffrigid.numerics import dot, norm
from diffrigid.pytree import replace
from diffrigid.shapes import Capsule, Disc, Sphere, edges, radius, vertices
from diffrigid.state import rotations


def convex_convex(a, x_a: Array, q_a: Array, b, x_b: Array, q_b: Array) -> Contacts:
    """Contacts of vertices of a with b, of b with a, and of crossing edges; a disc or sphere only by its own centre."""
    dim = x_a.shape[0]
    corners_a, corners_b = corners_of(a, x_a, q_a), corners_of(b, x_b, q_b)
    slack = slack_between(corners_a, radius(a), corners_b, radius(b))
    parts = []
    if not isinstance(b, Disc | Sphere):
        parts.append(_corners_against(corners_a, radius(a), b, x_b, q_b, slack))
    if not isinstance(a, Disc | Sphere):
        of_b = flipped(_corners_against(corners_b, radius(b), a, x_a, q_a, slack))
        if isinstance(a, Capsule) and isinstance(b, Capsule):  # end on end is one contact, which a's ends have already
            of_b = replace(of_b, gap=jnp.where(_past_ends(corners_b, a, x_a, q_a), FAR, of_b.gap))
        parts.append(of_b)
    contacts = joined(*parts)
    if dim == 2 or not edges(a, dim) or not edges(b, dim):
        return contacts
    rounding = radius(a) + radius(b)
    separated = _separates(parts[0], corners_a, rounding, slack)
    separated = separated | _separates(flipped(parts[1]), corners_b, rounding, slack)
    crossings = crossing_edges(a, corners_a, b, corners_b, contacts, separated, slack)
    number = -1.0 - lax.broadcasted_iota(slack.dtype, contacts.gap.shape, 0)
    return joined(replace(contacts, feature=number), crossings)


def corners_of(shape, x: Array, q: Array) -> Array:
    """Corners of the core in the world, (V, D, *batch) [m]."""
    so = rotations(x.shape[0])
    return jax.vmap(lambda corner: x + so.rotate(q, corner))(vertices(shape, x.shape[0]))


def slack_between(corners_a: Array, round_a: Array, corners_b: Array, round_b: Array) -> Array:
    """Distance within which two features coincide, by the smaller size, (*batch) [m]."""

    def size(corners, rounding):
        return jax.vmap(norm)(corners - corners.mean(0)[None]).max(0) + rounding

    return slack_of(lax.stop_gradient(jnp.minimum(size(corners_a, round_a), size(corners_b, round_b))))


def _corners_against(corners: Array, rounding: Array, b, x_b: Array, q_b: Array, slack: Array) -> Contacts:
    so = rotations(x_b.shape[0])
    middle = corners.mean(0)

    def one(p):
        inward = lax.stop_gradient(middle - p)
        both = jnp.stack(jnp.broadcast_arrays(p - x_b, inward))
        p_in_b, inward_in_b = jax.vmap(so.unrotate, in_axes=(None, 0))(q_b, both)
        distance, n = core_distance(b, p_in_b, inward_in_b, slack)
        gap, normal = distance - rounding - radius(b), so.rotate(q_b, n)
        return Contacts(gap=gap, normal=normal, point=p - (rounding + 0.5 * gap)[None] * normal)

    return jax.vmap(one)(corners)


def _past_ends(corners: Array, shape: Capsule, x: Array, q: Array) -> Array:
    """Whether corners (V, D, *batch) are not beside the axis of a capsule, but past its ends, (V, *batch) bool."""
    so = rotations(len(x))
    return jax.vmap(lambda p: jnp.abs(so.unrotate(q, p - x)[0]) >= shape.half_length)(corners)


def flipped(c: Contacts) -> Contacts:
    return Contacts(gap=c.gap, normal=-c.normal, point=c.point)


def _separates(c: Contacts, corners: Array, rounding: Array, slack: Array) -> Array:
    """Whether the normal at one of the corners is an axis that separates the two cores, (*batch) bool.

    It is if the corner is outside the other core and no corner of its own is lower along the normal.
    """

    def one(gap, normal, corner):
        height = jax.vmap(lambda other: dot(normal, other - corner))(corners)
        return (gap + rounding > slack) & (height.min(0) >= -slack)

    return jax.vmap(one)(c.gap, c.normal, corners).any(0)
