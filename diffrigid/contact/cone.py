"""Contacts that share a body, solved together: velocities that do not close, and impulses inside the friction cone.

With y the relative velocities at the contacts after all impulses P, k > 0 any number for each contact, and `project`
the nearest impulse in the sense of Coulomb,

    P = project(z),   z = P - (y - target n) / k,   y = v_rel + W P,   W = J G J^T

says at once that contacts do not pull, do not close, and slip only against all of their friction. It is solved by
Newton's method with the derivative D of `project`. Sticking makes (1 - D) + D W / k singular where contacts repeat
each other, as four corners on a floor do, so the method of multipliers is mixed in: D is taken (1 - e) D, with a
small e. Then B = 1 - (1 - e) D has an inverse contact by contact, and with u = G J^T dP, the change of the twists of
the bodies,

    (1 + G J^T B^-1 D J / k) u = G J^T B^-1 r,    dP = B^-1 (r - D J u / k)

so what is solved is as large as the bodies are many, and not the contacts.
Source: Alart & Curnier, Computer Methods in Applied Mechanics and Engineering 92 (1991) 353, for the equation;
Bertsekas, Constrained Optimization and Lagrange Multiplier Methods, 1982, for e.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.contact.sides import at_colliders, between_bodies, side_sum
from diffrigid.joints import Linkage, spread
from diffrigid.numerics import FOUND, dot, identity, inverse_matrix, norm, rows, safe_divide
from diffrigid.pytree import array, pytree, static
from diffrigid.state import rotations

ROUNDS = 40  # at most, of Newton's method
SMOOTHING = 3  # rounds after each Newton step
PATIENCE = 3  # rounds that do not lessen a small error: then it is rounding
REFINEMENTS = 8  # of the linear system of the derivative


@pytree
class Cone:
    """What C contacts demand of the velocity after their impulses."""

    on: Array = array("C")  # 1 where the contact takes part, else 0
    rest_speed: Array = array()  # (*batch) [m/s] slow, for the world: its impulses are found to a small part of it
    crowd: Array = array("C")  # contacts on the body that has more of them
    scale: Array = array("C")  # k [1/kg] of the order of the contact's mobility; the solution does not depend on it
    normal: Array = array("C", "D")
    target: Array = array("C")  # [m/s]
    mu: Array = array("C")


@pytree
class Arms:
    """Where C contacts act on their bodies; fields as in `Strikes`."""

    arm_a: Array = array("C", "D")
    arm_b: Array = array("C", "D")
    a: tuple[int, ...] = static()
    b: tuple[int, ...] = static()


@pytree
class Mobility:
    """What turns impulses on the N moving bodies into changes of velocity."""

    inverse_mass: Array = array("N")  # [1/kg]
    inverse_inertia: Any = None  # [1/(kg m^2)] world axes
    link: Linkage | None = None  # of the joints between them


def momentum_changes(arms: Any, P: Array, moving: int) -> tuple[Array, Array]:
    """Changes of m v (N, D) [N s] and L (N, A) [N m s] of the moving bodies by the impulses P on side a.

    Args:
        arms: with the fields of `Arms`.
    """
    so = rotations(P.shape[1])
    on_a = jnp.concatenate([P, jax.vmap(so.moment)(arms.arm_a, P)], axis=1)
    on_b = jnp.concatenate([-P, jax.vmap(so.moment)(arms.arm_b, -P)], axis=1)
    total = side_sum(on_a, on_b, arms.a, arms.b, moving)
    return total[:, : so.D], total[:, so.D :]


def velocities(mobility: Mobility, dp: Array, dL: Array) -> tuple[Array, Array, Array]:
    """Changes of v [m/s], w [rad/s] and L by impulses dp and dL on the bodies, and by what the joints make of them."""
    apply = rotations(dp.shape[1]).apply
    dv, dw = mobility.inverse_mass[:, None] * dp, jax.vmap(apply)(mobility.inverse_inertia, dL)
    if mobility.link is None:
        return dv, dw, dL
    more = spread(mobility.link, dv, dw)
    return dv + more[0], dw + more[1], dL + more[2]


def relative_changes(arms: Any, dv: Array, dw: Array) -> Array:
    """Change of the relative velocity at every contact, (C, D, *batch) [m/s], for changes of the bodies'."""
    so, both = rotations(dv.shape[1]), jnp.concatenate([dv, dw], axis=1)
    at_a, at_b = at_colliders(both, arms.a, 0.0), at_colliders(both, arms.b, 0.0)

    def point_velocity(at, arm):
        return at[: so.D] + so.cross(at[so.D :], arm)

    return jax.vmap(point_velocity)(at_a, arms.arm_a) - jax.vmap(point_velocity)(at_b, arms.arm_b)


@pytree
class Slope:
    """D, the derivative of `project` at z, contact by contact, as numbers and directions."""

    on: Array = array("C")  # 1 where the contact pushes, else 0
    slides: Array = array("C")  # 1 where it does at its bound of friction
    turn: Array = array("C")  # [-] how far the direction of sliding follows z; 1 where it sticks
    normal: Array = array("C", "D")
    along: Array = array("C", "D")  # of the sliding
    mu: Array = array("C")


def _excess(cone: Cone, P: Array, v_rel: Array, arms: Arms, mobility: Mobility) -> Array:
    """z, (C, D, *batch) [N s]."""
    y = v_rel + _moved(P, arms, mobility)
    return P - (y - cone.target[:, None] * cone.normal) / cone.scale[:, None]


def _moved(P: Array, arms: Arms, mobility: Mobility) -> Array:
    """W P: changes of the relative velocities, (C, D, *batch) [m/s]."""
    dv, dw, _ = velocities(mobility, *momentum_changes(arms, P, mobility.inverse_mass.shape[0]))
    return relative_changes(arms, dv, dw)


def _split(normal: Array, z: Array) -> tuple[Array, Array]:
    """Normal component and tangential part."""
    z_n = jax.vmap(dot)(normal, z)
    return z_n, z - z_n[:, None] * normal


def _project(cone: Cone, z: Array) -> Array:
    """Pushes at most, and rubs with mu times that at most."""
    z_n, z_t = _split(cone.normal, jnp.where(cone.on[:, None] > 0, z, 0.0))
    push = jnp.maximum(z_n, 0.0)
    size, bound = jax.vmap(norm)(z_t), cone.mu * push
    share = jnp.where(size < bound, 1.0, safe_divide(bound, size))
    return push[:, None] * cone.normal + share[:, None] * z_t


def _slope(cone: Cone, z: Array) -> Slope:
    z_n, z_t = _split(cone.normal, z)
    size, bound = jax.vmap(norm)(z_t), cone.mu * jnp.maximum(z_n, 0.0)
    on, slides = jnp.where(z_n > 0, cone.on, 0.0), (size >= bound).astype(z.dtype)
    turn, along = jnp.where(size < bound, 1.0, safe_divide(bound, size)), z_t / jnp.where(size > 0, size, 1.0)[:, None]
    return Slope(on=on, slides=slides, turn=turn, normal=cone.normal, along=along, mu=cone.mu)


def _sloped(slope: Slope, r: Array) -> Array:
    """D r, (C, D, *batch)."""
    r_n, r_t = _split(slope.normal, r)
    along = slope.slides * (slope.mu * r_n - slope.turn * jax.vmap(dot)(slope.along, r_t))
    return slope.on[:, None] * (r_n[:, None] * slope.normal + slope.turn[:, None] * r_t + along[:, None] * slope.along)


def _unsloped(slope: Slope, e: float, r: Array) -> tuple[Array, Array]:
    """B^-1 r and B^-1 D r, by components: normal, along the sliding, and across both."""
    r_n, r_t = _split(slope.normal, r)
    r_along = slope.slides * jax.vmap(dot)(slope.along, r_t)
    r_across = r_t - r_along[:, None] * slope.along
    on, kept = slope.on, 1.0 - slope.on * (1.0 - e)
    rest = 1.0 - on * (1.0 - e) * slope.turn  # e where it sticks
    drag = slope.slides * slope.mu * r_n / kept * on
    B_r = (r_n / kept)[:, None] * slope.normal + r_across / rest[:, None]
    BD_r = (on * r_n / kept)[:, None] * slope.normal + (on * slope.turn / rest)[:, None] * r_across
    return B_r + (r_along + (1.0 - e) * drag)[:, None] * slope.along, BD_r + drag[:, None] * slope.along


def _small(dtype: Any) -> float:
    """e: an error of relative size (rounding / e^2 + e / least eigenvalue of W / k) is left by each step."""
    return float(jnp.finfo(dtype).eps) ** 0.4


def _bodies_inverse(slope: Slope, cone: Cone, arms: Arms, mobility: Mobility) -> Array:
    """Inverse of 1 + G J^T B^-1 D J / k, (R, R, *batch) with R components of the twists of all bodies."""
    moving, (D, *batch) = mobility.inverse_mass.shape[0], arms.arm_a.shape[1:]
    so = rotations(D)
    size = D + so.A
    J_a, J_b = (jax.vmap(lambda arm: _by_units(so, arm))(arm) for arm in (arms.arm_a, arms.arm_b))  # (C, size, D)

    def answers(J):  # of each contact to unit twists of one of its bodies: impulses
        columns = jnp.swapaxes(J, 0, 1)
        back = jax.vmap(lambda y: _unsloped(slope, _small(y.dtype), y)[1])(columns)
        return jnp.swapaxes(back, 0, 1) / cone.scale[:, None, None]

    def block(J, back):  # J^T back, (C, size, size)
        each = jax.vmap(jax.vmap(dot, (None, 0)), (0, None))
        return jax.vmap(each)(J, back)

    back_a, back_b = answers(J_a), answers(J_b)
    own = side_sum(block(J_a, back_a), block(J_b, back_b), arms.a, arms.b, moving)
    diagonal = jnp.eye(moving, dtype=own.dtype).reshape(moving, moving, *[1] * (own.ndim - 1))
    whole = diagonal * own[:, None]
    between = between_bodies(arms.a, arms.b, moving)
    if between is not None:
        across = -jnp.concatenate([block(J_a, back_b), block(J_b, back_a), jnp.zeros_like(own[:1])])
        whole = whole + rows(across, between).sum(1).reshape(moving, moving, size, size, *batch)
    columns = jnp.moveaxis(whole, (1, 3), (0, 1)).reshape(moving * size, moving, size, *batch)

    def moved(column):
        dv, dw, _ = velocities(mobility, column[:, :D], column[:, D:])
        return jnp.concatenate([dv, dw], axis=1).reshape(-1, *batch)

    matrix = jax.vmap(moved, out_axes=1)(columns)
    return inverse_matrix(identity(matrix) + matrix)


def _by_units(so: Any, arm: Array) -> Array:
    """Velocity at an arm (D, *batch) for each unit twist of its body, (D + A, D, *batch)."""
    size, batch = so.D + so.A, arm.shape[1:]
    units = jnp.eye(size, dtype=arm.dtype).reshape(size, size, *[1] * len(batch))
    return jax.vmap(lambda unit: unit[: so.D] + so.cross(unit[so.D :], arm))(units + jnp.zeros_like(arm[:1])[None])


def _pushed_back(slope: Slope, cone: Cone, arms: Arms, twist: Array) -> Array:
    """B^-1 D J / k of the twists (C, *batch) of all bodies: impulses, (C, D, *batch)."""
    D = arms.arm_a.shape[1]
    by_body = twist.reshape(-1, D + rotations(D).A, *twist.shape[1:])
    y = relative_changes(arms, by_body[:, :D], by_body[:, D:])
    return _unsloped(slope, _small(y.dtype), y)[1] / cone.scale[:, None]


def _twists(P: Array, arms: Arms, mobility: Mobility) -> Array:
    """G J^T P: the change of the twists of all bodies by impulses, (C, *batch)."""
    dv, dw, _ = velocities(mobility, *momentum_changes(arms, P, mobility.inverse_mass.shape[0]))
    return jnp.concatenate([dv, dw], axis=1).reshape(-1, *P.shape[2:])


def _newton_step(r: Array, inverse: Array, slope: Slope, cone: Cone, arms: Arms, mobility: Mobility) -> Array:
    """dP of (B + D W / k) dP = r, (C, D, *batch)."""
    direct = _unsloped(slope, _small(r.dtype), r)[0]
    twist = (inverse * _twists(direct, arms, mobility)[None]).sum(1)
    return direct - _pushed_back(slope, cone, arms, twist)


@jax.custom_jvp
def solve_together(shared: Array, cone: Cone, v_rel: Array, arms: Arms, mobility: Mobility) -> Array:
    """Impulses of all contacts that take part, (C, D, *batch) [N s]; zero for the others.

    Args:
        shared: bool: there is such a contact in some world of the batch.
        v_rel: (C, D, *batch) [m/s] before the impulses.

    After every Newton step P is brought back into the cones, and made smoother by some rounds in which each contact
    takes a share of the masses of its bodies (Tonge et al. 2012). Without both, P may go round in circles.
    """
    rounding = jnp.finfo(v_rel.dtype).eps
    tolerance, least = 16.0 * rounding, rounding**0.6 * cone.rest_speed

    def busy(carry):
        count, _, best, error, since = carry
        small = jnp.where(since < PATIENCE, tolerance, jnp.where(since < 5 * PATIENCE, 1e-3, jnp.inf))
        return (count < ROUNDS) & jnp.any(error > small * speed(best) + least)

    def speed(P):
        return jnp.max(cone.scale[:, None] * jnp.abs(P), (0, 1))

    def smoother(_, P):
        z = _excess(cone, P, v_rel, arms, mobility)
        return _project(cone, P + (z - P) / cone.crowd[:, None])

    def again(carry):
        count, P, best, error, since = carry
        z = _excess(cone, P, v_rel, arms, mobility)
        r = _project(cone, z) - P
        size = speed(r)
        better = size < error
        best, since = jnp.where(better[None, None], P, best), jnp.where(better, 0, since + 1)
        slope = _slope(cone, z)
        dP = _newton_step(r, _bodies_inverse(slope, cone, arms, mobility), slope, cone, arms, mobility)
        P = lax.fori_loop(0, SMOOTHING, smoother, _project(cone, P + dP))
        return count + 1, P, best, jnp.minimum(size, error), since

    def iterate(nothing):
        error = jnp.full(v_rel.shape[2:], jnp.inf, v_rel.dtype)
        start = (0, smoother(0, nothing), nothing, error, jnp.zeros_like(error, np.int32))
        return lax.while_loop(busy, again, start)[2]

    return lax.cond(shared, iterate, lambda nothing: nothing, jnp.zeros_like(v_rel))


@solve_together.defjvp
def _solve_together_jvp(primals, tangents):
    """(1 - D + D W / k) dP = what the parameters change of `project(z)` at fixed P."""
    shared, cone, v_rel, arms, mobility = primals
    P = checkpoint_name(solve_together(*primals), FOUND)

    def projected(cone, v_rel, arms, mobility):
        return _project(cone, _excess(cone, P, v_rel, arms, mobility))

    moved = jax.jvp(projected, primals[1:], tangents[1:])[1]
    slope = lax.stop_gradient(_slope(cone, _excess(cone, P, v_rel, arms, mobility)))
    fixed = lax.stop_gradient((slope, cone, arms, mobility))

    def linear(x):
        return x - _sloped(slope, x - _moved(x, arms, mobility) / cone.scale[:, None])

    def refined(matvec, b, transposed):
        inverse = _bodies_inverse(*fixed)

        def step(r):
            return _newton_step(r, inverse, *fixed)

        approximate = (lambda r: jax.linear_transpose(step, b)(r)[0]) if transposed else step
        return lax.fori_loop(0, REFINEMENTS, lambda _, x: x + approximate(b - matvec(x)), jnp.zeros_like(b))

    def solve(matvec, b, transposed=False):
        return lax.cond(shared, lambda b: refined(matvec, b, transposed), jnp.zeros_like, b)

    return P, lax.custom_linear_solve(linear, moved, solve, transpose_solve=functools.partial(solve, transposed=True))
