"""Any rounded convex shape and a half-space."""

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.collide.contacts import Contacts
from diffrigid.numerics import dot
from diffrigid.shapes import radius, vertices
from diffrigid.state import rotations


def round_halfspace(a, x_a: Array, q_a: Array, b, x_b: Array, q_b: Array) -> Contacts:
    """A disc or sphere: one contact, whatever its orientation."""
    del q_a
    normal = rotations(x_a.shape[0]).rotate(q_b, b.normal)
    gap = dot(normal, x_a - x_b) - b.offset - a.radius
    normal = normal + jnp.zeros_like(x_a)
    return Contacts(gap=gap[None], normal=normal[None], point=(x_a - (a.radius + 0.5 * gap)[None] * normal)[None])


def convex_halfspace(a, x_a: Array, q_a: Array, b, x_b: Array, q_b: Array) -> Contacts:
    """One contact at each vertex of the core of a: gap = n . (vertex - x_b) - offset - radius."""
    so = rotations(x_a.shape[0])
    corners = vertices(a, x_a.shape[0])
    normal = so.rotate(q_b, b.normal)

    def one(corner):
        p = x_a + so.rotate(q_a, corner)
        gap = dot(normal, p - x_b) - b.offset - radius(a)
        return Contacts(gap=gap, normal=normal + jnp.zeros_like(p), point=p - (radius(a) + 0.5 * gap)[None] * normal)

    return jax.vmap(one)(corners)
