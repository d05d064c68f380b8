"""Gaps of a pair along the paths of its colliders, and their derivatives, for the search for their impact."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.collide import Contacts
from diffrigid.contact.held_up import held_up
from diffrigid.contact.levers import with_rates
from diffrigid.contact.sides import (
    Placed,
    Side,
    candidates_of,
    difference,
    gap_rates,
    place,
    reach_of,
    relative_acceleration,
    relative_velocity,
)
from diffrigid.numerics import dot, norm
from diffrigid.shapes import HalfSpace, radius, vertices
from diffrigid.state import rotations

NEAR = 1e-3  # [-] fraction of the smaller reach at which advancing hands over to polishing


class Gaps(NamedTuple):
    """K gaps at one time."""

    gap: Array  # (K, *batch) [m]
    rate: Array  # (K, *batch) [m/s]
    acceleration: Array  # (K, *batch) [m/s^2]
    pull: Array  # (K, *batch) [m/s^2] of it that of the material, without what a turning normal adds: presses at rest
    normal: Array | None  # (K, D, *batch) None: that of a half-space
    held: Any = None  # gaps and rates of `HeldUp`, each (K, *batch); None: nothing is held up
    feature: Array | None = None  # (K, *batch), as in `Contacts`


def gaps_at(a: Side, b: Side, s: Array) -> Gaps:
    """Gaps of all candidate contacts at time s (*batch) [s]."""
    at_a, at_b = place(a, s), place(b, s)
    if isinstance(b.shape, HalfSpace):
        return _gaps_of_corners(a, at_a, b)
    up = held_up(a, at_a, b, at_b, s)
    at_a, at_b = up.at_a, up.at_b
    contacts, moving = with_rates(a, at_a, b, at_b, candidates_of)
    acceleration = jax.vmap(functools.partial(_acceleration, at_a, at_b))(contacts, moving)

    def pull(n: Array, p: Array, gap: Array) -> Array:
        # At the cores: on a rounded surface, other material comes to the contact as it spins.
        at_cores = (p + (0.5 * gap + radius(a.shape))[None] * n, p - (0.5 * gap + radius(b.shape))[None] * n)
        return dot(n, relative_acceleration(at_a, at_b, *at_cores))

    pulls = jax.vmap(pull)(contacts.normal, contacts.point, contacts.gap)
    rates, held = gap_rates(contacts, at_a, at_b), None
    if up.speed is not None:
        held = contacts.gap, rates - jax.vmap(dot, (None, 0))(up.speed, contacts.normal)
    return Gaps(up.gaps(contacts), rates, acceleration, pulls, contacts.normal, held, contacts.feature)


def _acceleration(at_a: Placed, at_b: Placed, contact: Contacts, moving: Contacts) -> Array:
    """d2(gap)/ds2 of one contact, (*batch) [m/s^2], from its rates: it turns, and moves along both bodies."""
    n, p = contact.normal, contact.point
    cross = rotations(len(n)).cross

    def along(at: Placed, arm: Array) -> Array:  # of the velocity of the body where the contact is
        return at.a + cross(at.dw, arm) + cross(at.w, moving.point - at.v)

    arms = p - at_a.x, p - at_b.x
    turning = dot(moving.normal, relative_velocity(at_a, arms[0], at_b, arms[1]))
    return turning + dot(n, difference(along, at_a, arms[0], at_b, arms[1]))


def _gaps_of_corners(a: Side, at: Placed, b: Side) -> Gaps:
    """Gaps of all corners of a above a half-space.

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
    return Gaps(height, rate, acceleration, acceleration, None)


def least_of(gap: Array) -> Array:
    """1 for the smallest of the gaps (K, *batch), else 0."""
    return jax.nn.one_hot(jnp.argmin(gap, 0), len(gap), axis=0, dtype=gap.dtype)


def at_corners(a: Side, at: Placed, contacts: Contacts, of_corners: Array) -> Array:
    """Transfer flags of the corners of a, (V, *batch) bool, to half-space contacts at some of them, (K, *batch)."""
    so, margin = rotations(len(at.x)), NEAR * reach_of(a)

    def one(gap: Array, normal: Array, point: Array) -> Array:
        corner = so.unrotate(at.q, point + (radius(a.shape) + 0.5 * gap)[None] * normal - at.x)
        return (of_corners & (jax.vmap(norm)(_corners(a, len(at.x)) - corner[None]) <= margin[None])).any(0)

    return lax.stop_gradient(jax.vmap(one)(contacts.gap, contacts.normal, contacts.point))


def _corners(a: Side, dim: int) -> Array:
    """Vertices of the core of a from its centre of mass, body axes, (V, D, *batch) [m]."""
    r = vertices(a.shape, dim)
    if a.turn is not None:
        r = jax.vmap(rotations(dim).rotate, (None, 0))(a.turn, r)
    return r if a.offset is None else r + a.offset[None]
