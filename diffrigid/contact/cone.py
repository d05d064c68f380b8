"""What contacts may do: the cone of friction, and two projections onto it."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.numerics import dot, norm, safe_divide
from diffrigid.pytree import array, pytree


@pytree
class Cone:
    """What C contacts demand of the velocity after their impulses."""

    on: Array = array("C")  # 1 where the contact takes part, else 0
    rest_speed: Array = array()  # (*batch) [m/s] slow, for the world: its impulses are found to a small part of it
    sharing: Array = array("C")  # contacts on the body that has more of them
    scale: Array = array("C")  # k [1/kg] of the order of the contact's mobility; of many solutions it chooses one
    normal: Array = array("C", "D")
    target: Array = array("C")  # [m/s]
    mu: Array = array("C")
    most: Any = array("C", default=None)  # [N s] of a row that acts to both sides, as friction; elsewhere infinite
    spin: Any = array("K", default=None)  # [m] the K rows behind the first K contacts turn, and are loaded by these:
    # of the normal impulse of its contact each may act with `spin` along its normal, to both sides, and `mu` across it


def push(cone: Cone, z_n: Array, one_sided: Array) -> Array:
    """Normal impulse within its bounds: `one_sided`, or between -most and most."""
    if cone.most is None:
        return one_sided
    return jnp.where(jnp.isinf(cone.most), one_sided, jnp.clip(z_n, -cone.most, cone.most))


def put(spin: Array, values: Array, others: Array) -> Array:
    """`values` of all contacts and rows, with `others` for those of the rows that turn."""
    return jnp.concatenate([values[: len(spin)], others, values[2 * len(spin) :]])


def turning(spin: Array, values: Array) -> Array:
    """`values` of the rows that turn."""
    return values[len(spin) : 2 * len(spin)]


def loaded(cone: Cone, normal: Array, z_n: Array, bound: Array) -> tuple[Array, Array]:
    """Normal impulses, and bounds of what acts across, where those of contacts are known and load rows that turn."""
    if cone.spin is None:
        return normal, bound
    load = normal[: len(cone.spin)]
    most = cone.spin * load
    along = jnp.clip(turning(cone.spin, z_n), -most, most)
    return put(cone.spin, normal, along), put(cone.spin, bound, turning(cone.spin, cone.mu) * load)


@jax.jit
def split(normal: Array, z: Array) -> tuple[Array, Array]:
    """Normal component and tangential part."""
    z_n = jax.vmap(dot)(normal, z)
    return z_n, z - z_n[:, None] * normal


@jax.jit
def allowed(cone: Cone, z: Array) -> Array:
    """The impulse that pushes as z does, and rubs as z does, but with no more than mu times that; (C, D, *batch)."""
    z_n, z_t = split(cone.normal, jnp.where(cone.on[:, None] > 0, z, 0.0))
    normal = push(cone, z_n, jnp.maximum(z_n, 0.0))
    size, bound = jax.vmap(norm)(z_t), cone.mu * jnp.maximum(z_n, 0.0)
    normal, bound = loaded(cone, normal, z_n, bound)
    share = jnp.where(size < bound, 1.0, safe_divide(bound, size))
    return normal[:, None] * cone.normal + share[:, None] * z_t


def nearest(cone: Cone, z: Array) -> Array:
    """The impulse in the cone that is nearest to z, (C, D, *batch); of rows that turn, nearest under their load."""
    z_n, z_t = split(cone.normal, z)
    size, mu = jax.vmap(norm)(z_t), cone.mu
    sticks, parts = (size <= mu * z_n) & (z_n > 0), mu * size <= -z_n
    normal = jnp.where(sticks, z_n, jnp.where(parts, 0.0, (z_n + mu * size) / (1.0 + mu**2)))
    share = jnp.where(sticks, 1.0, safe_divide(mu * normal, size))
    normal = push(cone, z_n, normal)
    if cone.spin is not None:
        normal, bound = loaded(cone, normal, z_n, mu)
        share = put(cone.spin, share, turning(cone.spin, jnp.where(size < bound, 1.0, safe_divide(bound, size))))
    return cone.on[:, None] * (normal[:, None] * cone.normal + share[:, None] * z_t)
