"""The friction cone of contacts, and two projections onto it."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.numerics import dot, norm, safe_divide
from diffrigid.pytree import array, pytree


@pytree
class Cone:
    """Contact law of C contacts and rows: target velocities, and bounds of the impulses."""

    on: Array = array("C")  # 1 where the contact takes part, else 0
    rest_speed: Array = array()  # (*batch) [m/s] slow in this world: impulses are solved to a small fraction of it
    sharing: Array = array("C")  # number of contacts on that of its two bodies that has more of them
    scale: Array = array("C")  # k [1/kg] of the order of the contact's mobility; it selects one of many solutions
    normal: Array = array("C", "D")
    target: Array = array("C")  # [m/s]
    mu: Array = array("C")
    most: Any = array("C", default=None)  # [N s] bound of a two-sided row, as joint friction; elsewhere infinite
    spin: Any = array("K", default=None)  # [m] of the K rolling rows, which follow the first K contacts: times the
    # normal impulse of its contact, `spin` bounds a row along the normal, two-sided, and `mu` bounds it across


def push(cone: Cone, z_n: Array, one_sided: Array) -> Array:
    """Normal impulse within its bounds: `one_sided`, or z_n clipped to [-most, most] in a two-sided row."""
    if cone.most is None:
        return one_sided
    return jnp.where(jnp.isinf(cone.most), one_sided, jnp.clip(z_n, -cone.most, cone.most))


def put(spin: Array, values: Array, others: Array) -> Array:
    """Replace the entries of the rolling rows in `values`, of all contacts and rows, by `others`."""
    return jnp.concatenate([values[: len(spin)], others, values[2 * len(spin) :]])


def turning(spin: Array, values: Array) -> Array:
    """Entries of `values` for the rolling rows."""
    return values[len(spin) : 2 * len(spin)]


def without_turning(count: int, values: Array) -> Array:
    """Entries of `values` without those for `count` rolling rows."""
    return jnp.concatenate([values[:count], values[2 * count :]])


def loaded(cone: Cone, normal: Array, z_n: Array, bound: Array) -> tuple[Array, Array]:
    """Normal impulses and tangential bounds, those of rolling rows set by the normal impulses of their contacts."""
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
    """Project z onto the cone, (C, D, *batch): its normal part if it pushes, its tangential part up to mu times it."""
    z_n, z_t = split(cone.normal, jnp.where(cone.on[:, None] > 0, z, 0.0))
    normal = push(cone, z_n, jnp.maximum(z_n, 0.0))
    size, bound = jax.vmap(norm)(z_t), cone.mu * jnp.maximum(z_n, 0.0)
    normal, bound = loaded(cone, normal, z_n, bound)
    share = jnp.where(size < bound, 1.0, safe_divide(bound, size))
    return normal[:, None] * cone.normal + share[:, None] * z_t


def nearest(cone: Cone, z: Array) -> Array:
    """Project z to the nearest impulse in the cone, (C, D, *batch); rolling rows under the load of their contacts."""
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
