"""Rotations of space. The same verbs as `so2`, so that one code serves both.

Orientation q = unit quaternion (w, x, y, z), (4, *batch), body to world; in code `s, u = q[:1], q[1:]`, so that
`w` stays the angular velocity. Vectors, angular velocities and momenta (3, *batch); inertia (3, 3, *batch).
Where there are no batch axes, what is decorated by `whole` is computed by its twin in `so3_whole`.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid import so3_whole
from diffrigid.branches import any_world
from diffrigid.gathers import fold
from diffrigid.numerics import components, dot, half_turn, normalise, safe_divide, safe_sqrt
from diffrigid.so3_whole import whole

D, A, Q = 3, 3, 4  # components of a vector, of an angular velocity, of an orientation
SERIES_ORDER = 6  # of the free rotation within a step; see turn_series
RESOLVED = 2.0  # [rad] largest turn within a step that the series resolves; see free_turn


@jax.jit
@whole(so3_whole.cross, 1, 1)
def cross(w: Array, r: Array) -> Array:
    """w x r: velocity of a point at r on a body that spins with w."""
    (a, b, c), (x, y, z) = w, r
    return components(b * z - c * y, c * x - a * z, a * y - b * x)


moment = cross  # r x F: torque of a force F at r


@jax.jit
@whole(so3_whole.rotate, 1, 1)
def rotate(q: Array, r: Array) -> Array:
    """Rotate r from body axes to world axes: r + 2 s (u x r) + 2 u x (u x r)."""
    s, x, y, z = q
    return components(*_rotated(s, x, y, z, r))


def _rotated(s: Array, x: Array, y: Array, z: Array, r: Any) -> list[Array]:
    """Components of r + 2 s (u x r) + 2 u x (u x r), u = (x, y, z)."""
    a, b, c = r
    p, q, r = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return [a + s * p + y * r - z * q, b + s * q + z * p - x * r, c + s * r + x * q - y * p]


@jax.jit
@whole(so3_whole.unrotate, 1, 1)
def unrotate(q: Array, r: Array) -> Array:
    """Rotate r from world axes to body axes."""
    s, x, y, z = q
    return components(*_rotated(-s, x, y, z, r))


@whole(so3_whole.compose, 1, 1)
def compose(q: Array, p: Array) -> Array:
    """Rotation p followed by q, brought back to unit length, so that rounding does not accumulate."""
    return _unit_product(q, p)


@whole(so3_whole.exp, 1)
def exp(phi: Array) -> Array:
    """Quaternion of the rotation vector phi [rad], (3, *batch)."""
    return components(*_exp(phi))


@whole(so3_whole.turn_by, 1, 1)
def turn_by(phi: Array, q: Array) -> Array:
    """Turn q by the rotation vector phi in world axes, (A, *batch) [rad]."""
    return _unit_product(_exp(phi), q)


@whole(so3_whole.turn_in_body, 1, 1)
def turn_in_body(q: Array, phi: Array) -> Array:
    """Turn q by the rotation vector phi in body axes, (A, *batch) [rad]."""
    return _unit_product(q, _exp(phi))


def _exp(phi: Array) -> list[Array]:
    """Components of the quaternion `exp`. XLA would recompute a vector for each component that is picked from it."""
    x, y, z = phi
    s, scale = half_turn(x * x + y * y + z * z)
    return [s, scale * x, scale * y, scale * z]


def _product(q: Any, p: Any) -> list[Array]:
    """Components of the quaternion product q p."""
    (s, a, b, c), (t, x, y, z) = q, p
    return [
        s * t - a * x - b * y - c * z,
        s * x + a * t + b * z - c * y,
        s * y - a * z + b * t + c * x,
        s * z + a * y - b * x + c * t,
    ]


def _unit_product(q: Any, p: Any) -> Array:
    product = _product(q, p)
    # One Newton step for 1 / |q| about 1: exact to rounding for products of unit quaternions.
    scale = 1.5 - 0.5 * sum(c * c for c in product)
    return components(*(scale * c for c in product))


def log(q: Array) -> Array:
    """Rotation vector of q, (3, *batch) [rad], of length at most pi."""
    q = jnp.where(q[:1] < 0, -q, q)
    s, u = q[0], q[1:]
    square = dot(u, u)
    small = square < 1e-8
    sine = safe_sqrt(jnp.where(small, 1e-8, square))
    long = jnp.maximum(s, 0.5)
    series = 2.0 / long * (1.0 - square / (3.0 * long * long))  # of arctan(|u| / s) / |u|
    scale = jnp.where(small, series, 2.0 * jnp.arctan2(sine, s) / sine)
    return scale[None] * u


@jax.jit
@whole(so3_whole.matrix_product, 2, 1)
def matrix_product(m: Array, r: Array) -> Array:
    """Product of a matrix (3, 3, *batch) and a vector (3, *batch)."""
    return components(*_product_of_rows(_entries(m), r))


def _entries(m: Array) -> list[list[Array]]:
    return [list(row) for row in m]


def _product_of_rows(m: Any, r: Any) -> list[Array]:
    x, y, z = r
    return [a * x + b * y + c * z for a, b, c in m]


def _trace(m: Array) -> Array:
    return m[0, 0] + m[1, 1] + m[2, 2]


def _matrix(q: Array) -> list[list[Array]]:
    """Entries of the rotation matrix of q."""
    s, x, y, z = q
    u, v, w = 2.0 * x, 2.0 * y, 2.0 * z
    xx, yy, zz, xy, xz, yz = u * x, v * y, w * z, u * y, u * z, v * z
    sx, sy, sz = s * u, s * v, s * w
    return [[1.0 - yy - zz, xy - sz, xz + sy], [xy + sz, 1.0 - xx - zz, yz - sx], [xz - sy, yz + sx, 1.0 - xx - yy]]


def inverse_inertia(inertia: Array) -> Array:
    """Inverse of a symmetric (3, 3, *batch) matrix by cofactors, [1/(kg m^2)]."""
    trace = lax.stop_gradient(_trace(inertia))[None, None]
    a, b, c = inertia / trace  # normalised: the square of a determinant may underflow
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)
    return jnp.stack([bc, ca, ab], axis=1) / dot(a, bc)[None, None] / trace


@whole(so3_whole.spin, 2, 1, 1)
def spin(inertia: Array, q: Array, w: Array) -> Array:
    """Angular momentum L = R I R^T w, world axes [kg m^2/s]."""
    s, x, y, z = q
    l = _product_of_rows(_entries(inertia), _rotated(-s, x, y, z, w))
    return components(*_rotated(s, x, y, z, l))


def unspin(inverse: Array, q: Array, L: Array) -> Array:
    """Angular velocity w = R I^-1 R^T L, world axes [rad/s], from the inverse inertia in body axes."""
    return spin(inverse, q, L)


@jax.jit
@whole(so3_whole.world_inverse, 2, 1)
def world_inverse(inverse: Array, q: Array) -> Array:
    """Inverse inertia in world axes, R I^-1 R^T, (3, 3, *batch); `apply` multiplies by it."""
    R = _matrix(q)
    half = [_product_of_rows(_entries(inverse), row) for row in R]  # rows of R I^-1, which is symmetric
    return components(*(components(*_product_of_rows(half, row)) for row in R))


apply = matrix_product  # I^-1 tau, both in world axes


def mobility(inverse: Array, r: Array, mid: Array) -> Array:
    """Velocity at r for a unit impulse at mid, by rotation alone: (3, 3, *batch), -[r] I^-1 [mid]."""
    cross_rows = jax.vmap(cross, in_axes=(None, 0))
    by_moments = jnp.swapaxes(cross_rows(r, inverse), 0, 1)  # [r] I^-1: I^-1 is symmetric, its rows are its columns
    return cross_rows(mid, by_moments)  # a row times -[mid] is mid x row


@jax.custom_jvp
def free_turn(inverse: Array, q: Array, L: Array, span: Array) -> tuple[Array, Array]:
    """Free rotation through a step of length span (*batch) [s]: a rotation of the world axes, and one in body axes.

    After time s the orientation is exp(carry s) o q o exp(sum_k turn[k] s^(k+1)), with carry (3, *batch) [rad/s] in
    world axes and turn (K, 3, *batch) in body axes. L is kept exactly because it is not integrated at all.

    With l = R^T L and any number c, a body of inverse inertia I^-1 is carried by c L, and turns in its own axes by
    u = (I^-1 - c) l, because in Euler's equations l' = l x w the part along l has no effect. With 1/c between the two
    moments that differ least, u is the spin of a symmetric top about its axis e, constant, and the whole is exact
    (Goldstein, Classical Mechanics, section 5.6). Otherwise it is `turn_series` of u, with an error of (u s)^7 / 5040.
    Where u turns by more than RESOLVED within the step, that series would diverge: there the body is the symmetric top
    whose moment across e is that in the direction of l, so that it also spins right about any principal axis. Its
    energy is between the least and the most that a turn about e leads to.

    Where all bodies turn about a principal axis, as balls and cubes always do, only the first term is
    computed. Its derivatives are those of the whole, which other inertias have.
    """
    l = unrotate(q, L)
    w = matrix_product(inverse, l)

    def first(inverse, q, L, span):
        del inverse, q, L, span
        return jnp.zeros_like(w), jnp.concatenate([w[None], jnp.zeros((SERIES_ORDER - 1, *w.shape), w.dtype)])

    most, of_l, of_w = (fold(jnp.maximum, jnp.abs(a), 0) for a in (cross(l, w), l, w))
    wanders = most > 16.0 * jnp.finfo(w.dtype).eps * of_l * of_w
    return lax.cond(any_world(wanders), _as_top, first, inverse, q, L, span)


@free_turn.defjvp
def _free_turn_jvp(primals, tangents):
    return jax.jvp(_as_top, primals, tangents)


def _as_top(inverse: Array, q: Array, L: Array, span: Array) -> tuple[Array, Array]:
    """`free_turn` for bodies of any inertia."""
    e, l = _odd_axis(lax.stop_gradient(inverse)), unrotate(q, L)
    about = dot(e, matrix_product(inverse, e))
    c = 0.5 * (_trace(inverse) - about)
    rest = inverse - c[None, None] * _eye(c)
    resolved = _most_turn(*map(lax.stop_gradient, (rest, about - c, l))) * span**2 < RESOLVED**2
    turn = turn_series(rest, q, jnp.where(resolved[None], L, 0.0), None)
    across = lax.stop_gradient(normalise(l - dot(e, l)[None] * e))
    c = c + jnp.where(resolved, 0.0, dot(across, matrix_product(rest, across)))
    top = jnp.where(resolved, 0.0, (about - c) * dot(e, l))[None] * e
    return c[None] * L, jnp.concatenate([turn[:1] + top[None], turn[1:]])


def _most_turn(rest: Array, k: Array, l: Array) -> Array:
    """Bound of |u|^2, (*batch), however u = rest l moves, from quantities that are conserved.

    rest has the eigenvalues k, d and -d, so that u = (k l1, d l2, -d l3), |u|^2 = k (k l1^2) + d^2 (l2^2 + l3^2), and
    l . u = k l1^2 + d (l2^2 - l3^2) is constant, as E and |l| are.
    """
    d = safe_sqrt(jnp.maximum(0.5 * (sum(dot(row, row) for row in rest) - k**2), 0.0))
    constant, square = dot(l, matrix_product(rest, l)), dot(l, l)
    return jnp.abs(k) * (jnp.abs(constant) + d * square) + d**2 * square


def _eye(like: Array) -> Array:
    return jnp.eye(3, dtype=like.dtype).reshape(3, 3, *[1] * like.ndim)


def _odd_axis(inverse: Array) -> Array:
    """Unit vector, body axes, of the principal axis whose moment differs most from the other two; (3, *batch).

    The part of I^-1 without trace has its largest eigenvalue there, as the sum of the other two. Its 64th power has
    nothing else left but where the moments are about evenly spaced.
    """
    trace = _trace(inverse)

    def squared(_, S):
        S = jax.vmap(matrix_product, (None, 0))(S, S)  # of a symmetric matrix: its rows are its columns
        return safe_divide(S, _trace(S)[None, None])

    first, second, third = lax.fori_loop(0, 6, squared, 3.0 * inverse / trace[None, None] - _eye(trace))
    second_is_more, first_is_most = second[1] >= third[2], first[0] >= jnp.maximum(second[1], third[2])
    axis = jnp.where(first_is_most[None], first, jnp.where(second_is_more[None], second, third))
    return normalise(axis, jnp.broadcast_to(_eye(trace)[2], axis.shape))


@jax.custom_jvp
def carried(phi: Array, q: Array) -> Array:
    """`turn_by`, which returns q as it is where all of phi is zero, as for balls and cubes in free flight."""
    return lax.cond(any_world(phi != 0), turn_by, lambda _, q: q, phi, q)


@carried.defjvp
def _carried_jvp(primals, tangents):
    return jax.jvp(turn_by, primals, tangents)  # of a body at rest phi is zero, but not its derivative


def turn_series(inverse: Array, q: Array, L: Array, tau: Array | None) -> Array:
    """Rotation vector, in body axes, after time s, as a power series sum_k turn[k] s^(k+1); (K, 3, *batch).

    In body axes, with l = R^T L, t = R^T tau and w = I^-1 l:

        l' = l x w + t,    t' = t x w                          (Euler's equations; tau constant in the world)
        turn' = w + turn x w / 2 + turn x (turn x w) / 12      (inverse right Jacobian; Magnus series)

    Truncated after s^6: the error of one step is of order (w s)^7 / 5040, and none where l is parallel to w.
    Source: Iserles et al., Lie-group methods, Acta Numerica 2000, section 4; Hairer, Lubich, Wanner,
    Geometric Numerical Integration, VII.5.
    """
    l = unrotate(q, L)
    w = matrix_product(inverse, l)
    drives = [l, w] if tau is None else [l, w, unrotate(q, tau)]
    first = jnp.stack(drives)[:, None]  # l, turn and, if there is one, t: each is driven by its product with w
    empty = jnp.zeros((1, SERIES_ORDER - 1, *w.shape), w.dtype)
    start = jnp.concatenate([first, empty + jnp.zeros_like(first)], axis=1)
    rates, twists = jnp.concatenate([w[None], empty[0]]), jnp.zeros_like(start[0])

    def put(coefficients, k, value):
        return lax.dynamic_update_index_in_dim(coefficients, value, k, 0)

    def following(n, carry):
        series, rates, twists = carry
        l_w, turn_w, *t_w = jax.vmap(_coefficient, (0, None, None))(series, rates, n - 1)
        twist_turn = _coefficient(series[1], twists, n - 2)
        l = (l_w if tau is None else l_w + lax.dynamic_index_in_dim(series[2], n - 1, 0, False)) / n
        w = matrix_product(inverse, l)
        turn = (w + 0.5 * turn_w + twist_turn / 12.0) / (n + 1)
        new = jnp.stack([l, turn, *(t / n for t in t_w)])
        return put(jnp.swapaxes(series, 0, 1), n, new).swapaxes(0, 1), put(rates, n, w), put(twists, n - 1, turn_w)

    return lax.fori_loop(1, SERIES_ORDER, following, (start, rates, twists))[0][1]


def _coefficient(a: Array, b: Array, n: Array) -> Array:
    """Coefficient n of the cross product of power series, sum_i a[i] x b[n-i]; (K, 3, *batch) -> (3, *batch)."""
    reversed_b = lax.concatenate([lax.rev(b, (0,)), jnp.zeros_like(b)], 0)
    b = lax.dynamic_slice_in_dim(reversed_b, SERIES_ORDER - 1 - n, SERIES_ORDER, 0)
    return jax.vmap(cross)(a, b).sum(0)


def turn_rate(phi: Array, w: Array) -> Array:
    """Rate of the rotation vector phi, with q = q0 o exp(phi), for an angular velocity w in body axes.

    (3, *batch) [rad/s], to fourth order in phi: the inverse right Jacobian, as in `turn_series`.
    """
    twist = cross(phi, w)
    return w + 0.5 * twist + cross(phi, twist) / 12.0


@whole(so3_whole.rate, 1, 1)
def rate(w: Array, q: Array) -> Array:
    """dq/dt for an angular velocity w in world axes, (4, *batch) [1/s]."""
    return 0.5 * components(*_product([jnp.zeros_like(w[0]), *w], q))


@whole(so3_whole.difference, 1, 1)
def difference(q: Array, p: Array) -> Array:
    """Orientation p in the axes of q, q^-1 o p."""
    s, x, y, z = q
    return _unit_product([s, -x, -y, -z], p)


def chord(q: Array) -> Array:
    """Axis of q times twice the sine of half its angle, (3, *batch): the rotation vector to first order, and zero for
    no other turn."""
    return jnp.where(q[:1] < 0, -2.0, 2.0) * q[1:]


def gyroscopic(inertia: Array, q: Array, w: Array) -> Array:
    """w x L, (3, *batch) [N m], world axes: the torque that a steady rotation would need."""
    return cross(w, spin(inertia, q, w))


def precession(L: Array, w: Array) -> Array:
    """L x w = I dw of a free body, (3, *batch) [N m], world axes: Euler's equations."""
    return cross(L, w)


def tangents(n: Array) -> list[Array]:
    """Two unit vectors that with the unit vector n make a right-handed frame, (3, *batch) each.

    Smooth except where n[2] changes its sign. Source: Duff et al., J. Computer Graphics Techniques 6 (2017) 1.
    """
    x, y, z = n
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    return [components(1.0 + sign * x * x * a, sign * b, -sign * x), components(b, sign + y * y * a, -y)]
