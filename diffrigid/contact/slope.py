"""The derivative of the projection `allowed`, and a Newton step with it that solves a system of the bodies' size.

D is the derivative of `allowed` at z, e the compliance of contacts; see `together.py`. B = 1 - (1 - e) D is inverted
contact by contact, and with u = G J^T dP, the change of the twists of the bodies,

    (B + D W / k) dP = r:    (1 + G J^T B^-1 D J / k) u = G J^T B^-1 r,    dP = B^-1 (r - D J u / k)
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.contact.cone import Cone, loaded, put, split, turning
from diffrigid.contact.mobility import Arms, Mobility, at_contacts, twists
from diffrigid.linear import solve_regular
from diffrigid.numerics import dot, norm, safe_divide
from diffrigid.pytree import array, pytree, replace, static


@pytree
class Slope:
    """D, the derivative of `allowed` at z, contact by contact, as numbers and directions."""

    on: Array = array("C")  # 1 where the contact pushes, else 0
    slides: Array = array("C")  # 1 where friction is at its bound
    bends: Array = array("C")  # [-] derivative of friction across the sliding by that of z; 1 where it sticks
    normal: Array = array("C", "D")
    along: Array = array("C", "D")  # of the sliding
    mu: Array = array("C")
    free: Any = array("K", default=None)  # rolling rows: 1 where their normal part is within its bounds
    spin: Any = array("K", default=None)  # [m] where it is at its bound: its derivative with respect to the load
    e: float = static(default=0.0)  # [-] compliance


def slope_at(cone: Cone, z: Array, e: float) -> Slope:
    """D at z."""
    z_n, z_t = split(cone.normal, z)
    size, bound = jax.vmap(norm)(z_t), cone.mu * jnp.maximum(z_n, 0.0)
    if cone.spin is not None:
        bound = loaded(cone, jnp.maximum(z_n, 0.0), z_n, bound)[1]
    follows = z_n > 0 if cone.most is None else jnp.where(jnp.isinf(cone.most), z_n > 0, jnp.abs(z_n) < cone.most)
    on, slides = jnp.where(follows, cone.on, 0.0), (size >= bound).astype(z.dtype)
    bends, along = jnp.where(size < bound, 1.0, safe_divide(bound, size)), z_t / jnp.where(size > 0, size, 1.0)[:, None]
    slope = Slope(on=on, slides=slides, bends=bends, normal=cone.normal, along=along, mu=cone.mu, e=e)
    if cone.spin is None:
        return slope
    load, about = jnp.maximum(z_n[: len(cone.spin)], 0.0), turning(cone.spin, z_n)
    free = (jnp.abs(about) < cone.spin * load).astype(z.dtype)
    on = put(cone.spin, on, turning(cone.spin, cone.on))
    return replace(slope, on=on, free=free, spin=(1.0 - free) * cone.spin * jnp.sign(about))


def sloped(slope: Slope, r: Array) -> Array:
    """D r, (C, D, *batch)."""
    r_n, r_t = split(slope.normal, r)
    load = r_n
    if slope.spin is not None:
        load = put(slope.spin, r_n, (slope.on * r_n)[: len(slope.spin)])
        r_n = put(slope.spin, r_n, slope.free * turning(slope.spin, r_n) + slope.spin * turning(slope.spin, load))
    along = slope.slides * (slope.mu * load - slope.bends * jax.vmap(dot)(slope.along, r_t))
    return slope.on[:, None] * (r_n[:, None] * slope.normal + slope.bends[:, None] * r_t + along[:, None] * slope.along)


def _unsloped(slope: Slope, r: Array) -> tuple[Array, Array]:
    """B^-1 r and B^-1 D r, by components: normal, along the sliding, and across both."""
    r_n, r_t = split(slope.normal, r)
    r_along = slope.slides * jax.vmap(dot)(slope.along, r_t)
    r_across = r_t - r_along[:, None] * slope.along
    e, on = slope.e, slope.on
    kept = 1.0 - on * (1.0 - e)
    rest = 1.0 - on * (1.0 - e) * slope.bends  # e where it sticks
    if slope.spin is not None:
        kept = put(slope.spin, kept, 1.0 - turning(slope.spin, on) * slope.free * (1.0 - e))
        return _unsloped_rows(slope, r_n / kept, r_along, r_across, rest)
    drag = slope.slides * slope.mu * r_n / kept * on
    B_r = (r_n / kept)[:, None] * slope.normal + r_across / rest[:, None]
    BD_r = (on * r_n / kept)[:, None] * slope.normal + (on * slope.bends / rest)[:, None] * r_across
    return B_r + (r_along + (1.0 - e) * drag)[:, None] * slope.along, BD_r + drag[:, None] * slope.along


def _unsloped_rows(slope: Slope, x_n: Array, r_along: Array, r_across: Array, rest: Array):
    """`_unsloped` with rolling rows, whose bounds follow the first result, B^-1 r, at their contacts.

    Args:
        x_n: normal components of B^-1 r, without what rows get from their load.
    """
    e, on, count = slope.e, slope.on, len(slope.spin)
    load = put(slope.spin, x_n, (on * x_n)[:count])
    more = put(slope.spin, jnp.zeros_like(x_n), slope.spin * turning(slope.spin, on * load))
    own = put(slope.spin, on, turning(slope.spin, on) * slope.free) * x_n
    drag = on * slope.slides * slope.mu * load
    B_r = (x_n + (1.0 - e) * more)[:, None] * slope.normal + r_across / rest[:, None]
    BD_r = (own + more)[:, None] * slope.normal + (on * slope.bends / rest)[:, None] * r_across
    return B_r + (r_along + (1.0 - e) * drag)[:, None] * slope.along, BD_r + drag[:, None] * slope.along


def answer(slope: Slope, cone: Cone) -> Callable[[Array], Array]:
    """B^-1 D / k: impulses for relative velocities, (C, D, *batch)."""
    return lambda y: _unsloped(slope, y / cone.scale[:, None])[1]


def _pushed_back(slope: Slope, cone: Cone, arms: Arms, twist: Array) -> Array:
    """B^-1 D J / k times the stacked twists (R, *batch) of all bodies: impulses, (C, D, *batch)."""
    return answer(slope, cone)(at_contacts(arms, twist))


def newton_step(r: Array, matrix: Array, slope: Slope, cone: Cone, arms: Arms, mobility: Mobility) -> Array:
    """Solve (B + D W / k) dP = r for dP, (C, D, *batch); `matrix` is that of the twists (`bodies_matrix`)."""
    direct = _unsloped(slope, r)[0]
    return direct - _pushed_back(slope, cone, arms, solve_regular(matrix, twists(direct, arms, mobility)))
