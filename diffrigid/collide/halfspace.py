"""Any rounded convex shape and a half-space."""

import itertools

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.collide.contacts import Contacts
from diffrigid.gathers import first_highest
from diffrigid.numerics import components, dot
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
    return _at_corners(vertices(a, x_a.shape[0]), radius(a), x_a, q_a, b, x_b, q_b)


def box_halfspace(a, x_a: Array, q_a: Array, b, x_b: Array, q_b: Array) -> Contacts:
    """One contact at each corner of the lowest side of a: the lowest corners of all are among them."""
    so = rotations(x_a.shape[0])
    down = so.unrotate(q_a, so.rotate(q_b, b.normal)) + jnp.zeros_like(x_a)
    return _at_corners(_lowest_side(down, a.half), radius(a), x_a, q_a, b, x_b, q_b)


def _at_corners(corners: Array, rounding: Array, x_a: Array, q_a: Array, b, x_b: Array, q_b: Array) -> Contacts:
    so = rotations(x_a.shape[0])
    normal = so.rotate(q_b, b.normal)

    def one(corner):
        p = x_a + so.rotate(q_a, corner)
        gap = dot(normal, p - x_b) - b.offset - rounding
        return Contacts(gap=gap, normal=normal + jnp.zeros_like(p), point=p - (rounding + 0.5 * gap)[None] * normal)

    return jax.vmap(one)(corners)


def _lowest_side(normal: Array, half: Array) -> Array:
    """Corners of the side of a box that faces most against a normal, in the axes of the box, (2^(D-1), D, *batch) [m].

    It is the side across the axis along which the corners differ most in height.
    """
    dim, across = len(half), first_highest([jnp.abs(n * h) for n, h in zip(normal, half, strict=True)])
    lowest = [jnp.where(n < 0, h, -h) for n, h in zip(normal, half, strict=True)]

    def corner(signs: tuple[int, ...]) -> Array:
        # of the axes that follow the one across, in turn
        along = [jnp.where(across[i - 1], signs[0], signs[-1]) * half[i] for i in range(dim)]
        return components(*(jnp.where(across[i], lowest[i], along[i]) for i in range(dim)))

    return jnp.stack([corner(signs) for signs in itertools.product((-1, 1), repeat=dim - 1)])
