"""Rotations of the plane. The same verbs as `so3`, so that one code serves both.

Orientation q = (cos, sin), (2, *batch); angular velocity and momentum have one component, (1, *batch); the
inertia is a number, (*batch). Vectors (2, *batch). World and body rotation rates are the same in the plane.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.numerics import components, cos_sin, dot, normalise, unit_vector

D, A, Q = 2, 1, 2  # components of a vector, of an angular velocity, of an orientation


def perp(r: Array) -> Array:
    """Turn r by a quarter turn, (-y, x). By reversal, because XLA does not vectorise loops that stack components."""
    sign = 2.0 * lax.broadcasted_iota(r.dtype, r.shape, 0) - 1.0
    return sign * r[::-1]


@jax.jit
def rotate(q: Array, r: Array) -> Array:
    """Rotate r from body axes to world axes."""
    return q[:1] * r + q[1:] * perp(r)


@jax.jit
def unrotate(q: Array, r: Array) -> Array:
    """Rotate r from world axes to body axes."""
    return q[:1] * r - q[1:] * perp(r)


def compose(q: Array, p: Array) -> Array:
    """Rotation p followed by q, brought back to unit length, so that rounding does not accumulate."""
    return _unit_product(q, p)


def exp(phi: Array) -> Array:
    """Orientation of the rotation by phi [rad], (1, *batch)."""
    return components(*cos_sin(phi[0]))


def turn_by(phi: Array, q: Array) -> Array:
    """Turn q by the rotation vector phi in world axes, (A, *batch) [rad]."""
    return _unit_product(q, cos_sin(phi[0]))


def turn_in_body(q: Array, phi: Array) -> Array:
    """Turn q by the rotation vector phi in body axes: the same as `turn_by` in the plane."""
    return _unit_product(q, cos_sin(phi[0]))


def _unit_product(q: Any, p: Any) -> Array:
    """Product of unit complex numbers. XLA would recompute a vector for each component that is picked from it."""
    (a, b), (c, s) = q, p
    x, y = a * c - b * s, a * s + b * c
    # One Newton step for 1 / |product| about 1: exact to rounding for products of unit vectors.
    scale = 1.5 - 0.5 * (x * x + y * y)
    return components(scale * x, scale * y)


def log(q: Array) -> Array:
    """Angle of q in (-pi, pi], (1, *batch) [rad]."""
    return jnp.arctan2(q[1:], q[:1])


@jax.jit
def cross(w: Array, r: Array) -> Array:
    """w x r: velocity of a point at r on a body that spins with w."""
    return w * perp(r)


def moment(r: Array, F: Array) -> Array:
    """r x F: torque of a force F at r, (1, *batch)."""
    return dot(perp(r), F)[None]


def inverse_inertia(inertia: Array) -> Array:
    """1 / I [1/(kg m^2)]."""
    return 1.0 / inertia


def spin(inertia: Array, q: Array, w: Array) -> Array:
    """Angular momentum L = I w, world axes [kg m^2/s]."""
    del q
    return inertia[None] * w


def unspin(inverse: Array, q: Array, L: Array) -> Array:
    """Angular velocity w = I^-1 L, world axes [rad/s], from the inverse inertia in body axes."""
    del q
    return inverse[None] * L


def world_inverse(inverse: Array, q: Array) -> Array:
    """Inverse inertia in world axes; `apply` multiplies by it."""
    del q
    return inverse


def apply(inverse: Array, tau: Array) -> Array:
    """I^-1 tau, (1, *batch), both in world axes."""
    return inverse[None] * tau


def mobility(inverse: Array, r: Array, mid: Array) -> Array:
    """Velocity at r for a unit impulse at mid, by rotation alone: (2, 2, *batch), I^-1 r_perp mid_perp^T."""
    return inverse[None, None] * perp(r)[:, None] * perp(mid)[None]


def turn_series(inverse: Array, q: Array, L: Array, tau: Array | None) -> Array:
    """Angle turned after time s as a power series, sum_k turn[k] s^(k+1); (2, 1, *batch).

    Exact for a constant torque: w s + tau / I s^2 / 2.
    """
    del q
    w = inverse[None] * L
    return jnp.stack([w, jnp.zeros_like(w) if tau is None else 0.5 * inverse[None] * tau])


def free_turn(inverse: Array, q: Array, L: Array, span: Array) -> tuple[None, Array]:
    """`turn_series` without a torque. The first result, which carries the body in 3D, is None here."""
    del span
    return None, turn_series(inverse, q, L, None)


def turn_rate(phi: Array, w: Array) -> Array:
    """Rate of the rotation vector phi for an angular velocity w in body axes, (1, *batch) [rad/s]."""
    del phi
    return w


def rate(w: Array, q: Array) -> Array:
    """dq/dt for an angular velocity w in world axes, (2, *batch) [1/s]."""
    return w * perp(q)


def difference(q: Array, p: Array) -> Array:
    """Orientation p in the axes of q, q^-1 o p."""
    return unrotate(q, p)


def chord(q: Array) -> Array:
    """Twice the sine of half the angle of q, (1, *batch): the angle to first order, and zero for no other turn."""
    half = normalise(q + unit_vector(q, 0), fallback=unit_vector(q, 1))
    return 2.0 * half[1:]


def gyroscopic(inertia: Array, q: Array, w: Array) -> Array:
    """w x L, (1, *batch) [N m]: zero in the plane."""
    del inertia, q
    return jnp.zeros_like(w)


def precession(L: Array, w: Array) -> Array:
    """I dw of a free body, (1, *batch) [N m]: zero in the plane."""
    del L
    return jnp.zeros_like(w)
