"""Rotations of space. The same verbs as `so2`, so that one code serves both.

Orientation q = unit quaternion (w, x, y, z), (4, *batch), body to world; in code `s, u = q[:1], q[1:]`, so that
`w` stays the angular velocity. Vectors, angular velocities and momenta (3, *batch); inertia (3, 3, *batch).
"""

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.numerics import components, cos_sin, dot, safe_sqrt

D, A, Q = 3, 3, 4  # components of a vector, of an angular velocity, of an orientation
SERIES_ORDER = 6  # of the free rotation within a step; see turn_series


def cross(w: Array, r: Array) -> Array:
    """w x r: velocity of a point at r on a body that spins with w."""
    return _cycle(w * _cycle(r) - _cycle(w) * r)


def _cycle(r: Array) -> Array:
    """(y, z, x)."""
    return components(r[1], r[2], r[0])


moment = cross  # r x F: torque of a force F at r


def rotate(q: Array, r: Array) -> Array:
    """Body axes to world axes: r + 2 s (u x r) + 2 u x (u x r)."""
    s, u = q[:1], q[1:]
    t = 2.0 * cross(u, r)
    return r + s * t + cross(u, t)


def unrotate(q: Array, r: Array) -> Array:
    """World axes to body axes."""
    s, u = q[:1], q[1:]
    t = 2.0 * cross(u, r)
    return r - s * t + cross(u, t)


def compose(q: Array, p: Array) -> Array:
    """First p, then q; brought back to unit length, so that rounding does not accumulate."""
    product = _product(q, p)
    # One Newton step for 1 / |q| about 1: exact to rounding for products of unit quaternions.
    return product * (1.5 - 0.5 * dot(product, product))[None]


def _product(q: Array, p: Array) -> Array:
    """The quaternion product q p, (4, *batch)."""
    i = components(-p[1], p[0], -p[3], p[2])
    j = components(-p[2], p[3], p[0], -p[1])
    k = components(-p[3], -p[2], p[1], p[0])
    return q[:1] * p + q[1:2] * i + q[2:3] * j + q[3:] * k


def exp(phi: Array) -> Array:
    """Quaternion of the rotation vector phi [rad], (3, *batch)."""
    square = dot(phi, phi)
    small = square < 1e-8  # there the series below is exact to rounding, and sqrt has no derivative at 0
    half = 0.5 * safe_sqrt(jnp.where(small, 1.0, square))
    cosine, sine = cos_sin(half)
    s = jnp.where(small, 1.0 - square / 8.0, cosine)
    scale = jnp.where(small, 0.5 - square / 48.0, 0.5 * sine / half)
    return components(s, *(scale[None] * phi))


def turn_by(phi: Array, q: Array) -> Array:
    """q turned further by the rotation vector phi in world axes, (A, *batch) [rad]."""
    return compose(exp(phi), q)


def log(q: Array) -> Array:
    """Rotation vector of q, (3, *batch) [rad], of length at most pi."""
    q = jnp.where(q[:1] < 0, -q, q)
    s, u = q[0], q[1:]
    square = dot(u, u)
    small = square < 1e-8
    sine = safe_sqrt(jnp.where(small, 1.0, square))
    scale = jnp.where(small, 2.0 / jnp.maximum(s, 0.5), 2.0 * jnp.arctan2(sine, s) / sine)
    return scale[None] * u


def matrix_product(m: Array, r: Array) -> Array:
    """(3, 3, *batch) times (3, *batch), in components."""
    return m[:, 0] * r[:1] + m[:, 1] * r[1:2] + m[:, 2] * r[2:]


def inverse_inertia(inertia: Array) -> Array:
    """Inverse of a symmetric (3, 3, *batch) matrix by cofactors, [1/(kg m^2)]."""
    a, b, c = inertia
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)
    return jnp.stack([bc, ca, ab], axis=1) / dot(a, bc)[None, None]


def spin(inertia: Array, q: Array, w: Array) -> Array:
    """Angular momentum L = R I R^T w, world axes [kg m^2/s]."""
    return rotate(q, matrix_product(inertia, unrotate(q, w)))


def unspin(inverse: Array, q: Array, L: Array) -> Array:
    """Angular velocity w = R I^-1 R^T L, world axes [rad/s], from the inverse inertia in body axes."""
    return spin(inverse, q, L)


def world_inverse(inverse: Array, q: Array) -> Array:
    """Inverse inertia in world axes, R I^-1 R^T, (3, 3, *batch); `apply` multiplies by it."""
    rotate_rows = jax.vmap(rotate, in_axes=(None, 0))
    half = rotate_rows(q, jnp.swapaxes(inverse, 0, 1))  # rows: R (I^-1)^T e_j
    return rotate_rows(q, jnp.swapaxes(half, 0, 1))


apply = matrix_product  # I^-1 tau, both in world axes


def mobility(inverse: Array, r: Array) -> Array:
    """Velocity at r for a unit force impulse at r, by rotation alone: (3, 3, *batch), -[r] I^-1 [r]."""
    cross_rows = jax.vmap(cross, in_axes=(None, 0))
    half = cross_rows(r, jnp.swapaxes(inverse, 0, 1))  # rows: r x (column of I^-1)
    return cross_rows(r, jnp.swapaxes(half, 0, 1))


def turn_series(inverse: Array, q: Array, L: Array, tau: Array | None) -> Array:
    """Rotation vector, in body axes, after time s, as a power series sum_k turn[k] s^(k+1); (K, 3, *batch).

    The orientation is q o exp(turn(s)): on the unit sphere whatever the truncation, and L is kept exactly
    because it is not integrated at all. In body axes, with l = R^T L, t = R^T tau and w = I^-1 l:

        l' = l x w + t,    t' = t x w                          (Euler's equations; tau constant in the world)
        turn' = w + turn x w / 2 + turn x (turn x w) / 12      (inverse right Jacobian; Magnus series)

    Truncated after s^6: the error of one step is of order (w s)^7 / 5040, and none where l is parallel to w.
    Source: Iserles et al., Lie-group methods, Acta Numerica 2000, section 4; Hairer, Lubich, Wanner,
    Geometric Numerical Integration, VII.5.
    """
    l = [unrotate(q, L)]
    t = None if tau is None else [unrotate(q, tau)]
    w = [matrix_product(inverse, l[0])]
    for k in range(SERIES_ORDER - 1):
        l_next = _convolve(l, w) if t is None else _convolve(l, w) + t[k]
        if t is not None:
            t.append(_convolve(t, w) / (k + 1))
        l.append(l_next / (k + 1))
        w.append(matrix_product(inverse, l[-1]))
    turn, twist = [w[0]], []  # twist[n]: coefficient of s^(n+1) in turn x w
    for n in range(1, SERIES_ORDER):
        twist.append(_convolve(turn, w[:n]))
        rate = w[n] + 0.5 * twist[-1]
        if n > 1:
            rate = rate + _convolve(turn[: n - 1], twist[: n - 1]) / 12.0
        turn.append(rate / (n + 1))
    return jnp.stack(turn)


def _convolve(a: list[Array], b: list[Array]) -> Array:
    """The highest coefficient of the cross product of two power series of equal length, sum_i a[i] x b[-1-i]."""
    first, second = jnp.stack(a, axis=1), jnp.stack(b[::-1], axis=1)
    return cross(first, second).sum(1)


def turn_rate(phi: Array, w: Array) -> Array:
    """Rate of the rotation vector phi since q0, q = q0 o exp(phi), where the body turns with w in its own axes.

    (3, *batch) [rad/s], to fourth order in phi: the inverse right Jacobian, as in `turn_series`.
    """
    twist = cross(phi, w)
    return w + 0.5 * twist + cross(phi, twist) / 12.0


def rate(w: Array, q: Array) -> Array:
    """dq/dt of a body that turns with w in world axes, (4, *batch) [1/s]."""
    return 0.5 * _product(components(jnp.zeros_like(w[0]), *w), q)


def difference(q: Array, p: Array) -> Array:
    """p as seen from q: the rotation after which q brings to p."""
    return compose(components(q[0], *-q[1:]), p)


def sine(q: Array) -> Array:
    """Axis of q times the sine of its angle, (3, *batch): the rotation vector to first order."""
    return 2.0 * q[:1] * q[1:]


def gyroscopic(inertia: Array, q: Array, w: Array) -> Array:
    """w x L, (3, *batch) [N m], world axes: the torque that a steady rotation would take."""
    return cross(w, spin(inertia, q, w))


def tangents(n: Array) -> list[Array]:
    """Two unit vectors that with the unit vector n make a right-handed frame, (3, *batch) each.

    Smooth except where n[2] changes its sign. Source: Duff et al., J. Computer Graphics Techniques 6 (2017) 1.
    """
    x, y, z = n
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    return [components(1.0 + sign * x * x * a, sign * b, -sign * x), components(b, sign + y * y * a, -y)]
