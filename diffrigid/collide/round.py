"""Two discs, or two spheres."""

from jax import Array

from diffrigid.collide.contacts import Contacts
from diffrigid.numerics import norm, normalise, unit_vector


def round_round(a, x_a: Array, q_a: Array, b, x_b: Array, q_b: Array) -> Contacts:
    """One contact on the line of centres. Concentric: the normal is the last axis (any would do)."""
    del q_a, q_b
    span = x_a - x_b
    normal = normalise(span, fallback=unit_vector(span, -1))
    gap = norm(span) - a.radius - b.radius
    point = x_b + (b.radius + 0.5 * gap)[None] * normal
    return Contacts(gap=gap[None], normal=normal[None], point=point[None])
