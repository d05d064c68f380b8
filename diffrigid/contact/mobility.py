"""From impulses at contacts to changes of the bodies' velocities and back: J, G and J G J^T of `together`.

R has two meanings here: in `Arms`, and in `_first`, the rows of joints; in `Mobility.matrix`, and of stacked twists,
the N (D + A) components of the twists of all bodies, body after body.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.contact.cone import put
from diffrigid.contact.sums import at_colliders, between_bodies, pair_sum, pairs_of, side_sum
from diffrigid.fence import unfused
from diffrigid.forces import is_constant, total_wrench, within
from diffrigid.gathers import sum_rows
from diffrigid.linear import identity, matvec
from diffrigid.linkage import Linkage, damped_later, is_damped, spread
from diffrigid.numerics import dot, safe_divide, unit_vector
from diffrigid.pytree import array, pytree, replace, static
from diffrigid.state import State, rotations

if TYPE_CHECKING:
    from diffrigid.world import World


@pytree
class Arms:
    """Where C contacts act on their bodies; fields as in `Strikes`, which may be passed instead.

    The last R of them, those of `jac`, are rows along coordinates of joints: the first component of their velocities is
    the rate of a coordinate, that of their impulses acts along it, and the other components are zero.
    With `spin`, the K rows behind the K contacts are rolling rows: their velocities are w_a - w_b, their impulses are
    torque impulses; in 2D these are the first components.
    """

    arm_a: Array = array("C", "D")
    arm_b: Array = array("C", "D")
    mid_a: Any = array("C", "D", default=None)  # where impulses act; None: where velocities are, at the arms
    mid_b: Any = array("C", "D", default=None)
    turn: Any = array("C", "A", default=None)  # [rad] rotation of the impulses to where they act
    normal: Any = array("C", "D", default=None)  # with `lean` only
    lean: Any = array("C", "D", default=None)  # [-] change of the normal, to that along which changes of velocity act
    jac: Any = array("R", "2", "D + A", default=None)  # Jacobian of each joint coordinate for the twists of a and b
    mid_jac: Any = array("R", "2", "D + A", default=None)  # the same at the time when its impulse acts
    spin: Any = array("K", default=None)
    a: tuple[int, ...] = static()
    b: tuple[int, ...] = static()


@pytree
class Mobility:
    """G, the map from impulses on the N moving bodies to changes of their velocities."""

    inverse_mass: Array = array("N")  # [1/kg]
    inverse_inertia: Any = None  # [1/(kg m^2)] world axes
    matrix: Any = array("R", "R", default=None)  # all of G, where there are joints; R = N (D + A), body after body
    inertia: Any = None  # [kg m^2] world axes; with `matrix` only
    joined: frozenset[int] = static(default=frozenset())  # bodies that have a joint


def momentum_changes(arms: Any, P: Array, moving: int) -> tuple[Array, Array]:
    """Changes of m v (N, D) [N s] and L (N, A) [N m s] of the moving bodies by the impulses P on side a.

    Args:
        arms: with the fields of `Arms`.
    """
    so = rotations(P.shape[1])
    points, along, every = _points(arms), P[len(P) - _rows(arms) :, :1], P
    P = P[:points]
    mid_a, mid_b = mids(arms)
    if arms.turn is not None:
        P = P + jax.vmap(so.cross)(arms.turn[:points], P)
    push, moments = ([P], [-P]), tuple([jax.vmap(so.moment)(arm[:points], P)] for arm in (mid_a, -mid_b))
    if arms.spin is not None:
        for sign, pushes, turns in zip((1.0, -1.0), push, moments, strict=True):
            pushes.append(jnp.zeros_like(P))
            turns.append(sign * every[points : 2 * points, : so.A])
    if arms.jac is not None:
        for side, (pushes, turns) in enumerate(zip(push, moments, strict=True)):
            pushes.append(along * arms.mid_jac[:, side, : so.D])
            turns.append(along * arms.mid_jac[:, side, so.D :])

    def total(on_a: list[Array], on_b: list[Array]) -> Array:
        return side_sum(_joined(on_a), _joined(on_b), arms.a, arms.b, moving)

    return total(*push), total(*moments)


def mids(arms: Any) -> tuple[Array, Array]:
    """Arms at which impulses act on bodies a and b, (C, D, *batch) [m]."""
    return (arms.arm_a, arms.arm_b) if arms.mid_a is None else (arms.mid_a, arms.mid_b)


def _joined(parts: list[Array]) -> Array:
    return jnp.concatenate(parts) if len(parts) > 1 else parts[0]


def jointed(
    joints: tuple, link: Linkage, then: Linkage, ago: Array, inertia: Array, joined: frozenset[int],
    answering: Callable | None,
) -> Mobility:  # fmt: skip
    """Mobility of bodies connected by joints: the full matrix G. Inertias are in world axes.

    The joints react to an impulse as they are when it acts, `then`, the time `ago` (N, *batch) [s] before the end; by
    their damping since, as do forces; and as they are at the end, `link`. With one reaction only, a force that acts
    evenly over a step, in its middle, would be of first order only. G is used so often that it is made once, column by
    column.

    Args:
        answering: see `answers_of_forces`.
    """
    moving, *batch = link.inverse_mass.shape
    D, size = link.groups[0].a.x.shape[1], link.sides.shape[3]
    units = jnp.eye(moving * size, dtype=inertia.dtype).reshape(-1, moving, size, *[1] * len(batch))
    units = units + jnp.zeros_like(link.inverse_mass)[None, :, None]

    def answered(at: Linkage, dp: Array, dL: Array) -> tuple[Array, Array, Array]:
        dv, dw, _ = velocities(free(at), dp, dL)
        by_joints = spread(at, dv, dw)
        return dv + by_joints[0], dw + by_joints[1], dL + by_joints[2]

    def twist(unit: Array) -> Array:
        dv, dw, dL = answered(then, unit[:, :D], unit[:, D:])
        momentum = jnp.concatenate([dv / link.inverse_mass[:, None], dL], axis=1)
        twists = jnp.concatenate([dv, dw], axis=1)
        if any(map(is_damped, joints)):
            momentum = damped_later(joints, then, twists, momentum, ago)
        if answering is not None:
            taken = ago[:, None] * answering(dv, dw)
            # As by an implicit step, so that what damps much within a step stops a body, but does not throw it back.
            share = safe_divide(-(taken * twists).sum((0, 1)), (momentum * twists).sum((0, 1)))
            momentum = momentum + taken / (1.0 + jnp.maximum(share, 0.0))[None, None]
        return jnp.concatenate(answered(link, momentum[:, :D], momentum[:, D:])[:2], axis=1).reshape(-1, *batch)

    return replace(free(link), inertia=inertia, matrix=jax.vmap(twist, out_axes=1)(units), joined=joined)


def answers_of_forces(world: "World", state: State, span: Array) -> Callable | None:
    """How forces answer to changes of the velocities: a linear map from these, of v (N, D, *batch) [m/s] and w (N, A,
    *batch) [rad/s], to changes of forces and torques (N, D + A, *batch); None: no force depends on velocities.

    Args:
        state: of all bodies, perhaps at their own times.
        span: (*batch) [s] time for which they act.
    """
    forces = tuple(f for f in world.forces if not is_constant((f,)) and getattr(f, "control", None) is None)
    if not forces:
        return None

    def wrenches(v: Array, w: Array) -> Array:
        wrench = total_wrench(within(forces, span), world.bodies, replace(state, v=v, w=w), None)
        return jnp.concatenate([wrench.F, jnp.zeros_like(w) if wrench.tau is None else wrench.tau], axis=1)

    return lambda dv, dw: jax.jvp(wrenches, (state.v, state.w), (dv, dw))[1]


def free(link: Linkage) -> Mobility:
    """Mobility of the bodies without their joints."""
    return Mobility(inverse_mass=link.inverse_mass, inverse_inertia=link.inverse_inertia)


@jax.jit
def velocities(mobility: Mobility, dp: Array, dL: Array) -> tuple[Array, Array, Array]:
    """Changes of v [m/s], w [rad/s] and L by impulses dp and dL on the bodies and the reactions of the joints."""
    apply = rotations(dp.shape[1]).apply
    if mobility.matrix is None:
        return mobility.inverse_mass[:, None] * dp, jax.vmap(apply)(mobility.inverse_inertia, dL), dL
    twist = matvec(mobility.matrix, jnp.concatenate([dp, dL], axis=1).reshape(-1, *dp.shape[2:]))
    dv, dw = jnp.split(twist.reshape(len(dp), -1, *dp.shape[2:]), [dp.shape[1]], axis=1)
    return dv, dw, jax.vmap(apply)(mobility.inertia, dw)


@jax.jit
def relative_changes(arms: Any, dv: Array, dw: Array) -> Array:
    """Change of the relative velocity at every contact, (C, D, *batch) [m/s], for changes of the bodies' velocities."""
    if min(arms.b) >= len(dv):  # with statics only
        return _at_ends(arms, 0, dv, dw)
    if min(arms.a) >= len(dv):
        return -_at_ends(arms, 1, dv, dw)
    return _at_ends(arms, 0, dv, dw) - _at_ends(arms, 1, dv, dw)


def _at_ends(arms: Any, side: int, dv: Array, dw: Array) -> Array:
    """Changes of the velocities of colliders a (`side` 0) or b (1) at every contact, (C, D, *batch) [m/s]."""
    so, points, rows_from = rotations(dv.shape[1]), _points(arms), len(arms.a) - _rows(arms)
    ends, arm = ((arms.a, arms.arm_a), (arms.b, arms.arm_b))[side]
    v, w = at_colliders(dv, ends, 0.0), at_colliders(dw, ends, 0.0)
    parts = [v[:points] + jax.vmap(so.cross)(w[:points], arm[:points])]
    if arms.lean is not None:
        parts[0] = parts[0] + jax.vmap(dot)(arms.lean[:points], parts[0])[:, None] * arms.normal[:points]
    if arms.spin is not None:
        parts.append(_as_vectors(w[points:rows_from], so.D))
    if arms.jac is not None:
        rates = (arms.jac[:, side] * jnp.concatenate([v[rows_from:], w[rows_from:]], 1)).sum(1)
        parts.append(_first(rates if side == 0 else -rates, so.D))
    return _joined(parts)


def _rows(arms: Any) -> int:
    return 0 if arms.jac is None else len(arms.jac)


def _points(arms: Any) -> int:
    """Number of contacts, without rolling rows and rows of joints."""
    return len(arms.a) - _rows(arms) if arms.spin is None else len(arms.spin)


def _as_vectors(values: Array, D: int) -> Array:
    """Angular velocities (K, A, *batch) as vectors (K, D, *batch)."""
    return jnp.pad(values, [(0, 0), (0, D - values.shape[1]), *[(0, 0)] * (values.ndim - 2)])


def _first(values: Array, D: int) -> Array:
    """Numbers (R, *batch) as the first component of vectors, (R, D, *batch)."""
    return values[:, None] * unit_vector(jnp.zeros((D, *values.shape[1:]), values.dtype), 0)[None]


@jax.jit
def moved(P: Array, arms: Any, mobility: Mobility) -> Array:
    """J G J^T P: changes of the relative velocities by impulses, (C, D, *batch) [m/s]."""
    return relative_changes(arms, *velocities(mobility, *momentum_changes(arms, P, mobility.inverse_mass.shape[0]))[:2])


@jax.jit
def twists(P: Array, arms: Any, mobility: Mobility) -> Array:
    """G J^T P: stacked changes of the twists of all bodies by impulses, (R, *batch)."""
    return _twists(mobility, *momentum_changes(arms, P, mobility.inverse_mass.shape[0]))


def _twists(mobility: Mobility, dp: Array, dL: Array) -> Array:
    """Stacked twist changes, (R, *batch), by impulses dp (N, D, *batch) [N s] and dL (N, A, *batch) [N m s]."""
    return jnp.concatenate(velocities(mobility, dp, dL)[:2], axis=1).reshape(-1, *dp.shape[2:])


@jax.jit
def at_contacts(arms: Any, twist: Array) -> Array:
    """J u: `relative_changes` (C, D, *batch) for the stacked twists of all bodies, (R, *batch)."""
    D = arms.arm_a.shape[1]
    by_body = twist.reshape(-1, D + rotations(D).A, *twist.shape[1:])
    return relative_changes(arms, by_body[:, :D], by_body[:, D:])


def bodies_matrix(answer: Callable, arms: Any, mobility: Mobility) -> Array:
    """1 + G J^T A J, (R, R, *batch), with R the components of the stacked twists of all bodies.

    Args:
        answer: the linear map A, contact by contact: impulses (C, D, *batch) for relative velocities.
    """
    moving, (D, *batch) = mobility.inverse_mass.shape[0], arms.arm_a.shape[1:]
    so = rotations(D)
    size = D + so.A

    def by_units(arm: Array, all_jac: Array | None, side: int) -> Array:  # (C, size, D)
        J = jax.vmap(lambda arm: _by_units(so, arm))(arm)
        if arms.spin is not None:
            turns = jnp.eye(size, dtype=arm.dtype)[:, D:].reshape(1, size, so.A, *[1] * len(batch))
            J = put(arms.spin, J, jnp.broadcast_to(_as_vectors(turns[0], D), (len(arms.spin), size, D, *batch)))
        if all_jac is not None:
            rows = jax.vmap(lambda jac: _first(jac, D))(all_jac[:, side])
            J = jnp.concatenate([J[: len(arms.a) - len(arms.jac)], rows if side == 0 else -rows])
        return J

    J_a, J_b = (by_units(arm, arms.jac, side) for side, arm in enumerate((arms.arm_a, arms.arm_b)))
    mid_a, mid_b = J_a, J_b
    if arms.mid_a is not None or arms.jac is not None:
        mid_a, mid_b = (by_units(arm, arms.mid_jac, side) for side, arm in enumerate(mids(arms)))
    if arms.lean is not None:
        J_a, J_b = (J + (J * arms.lean[:, None]).sum(2, keepdims=True) * arms.normal[:, None] for J in (J_a, J_b))
    if arms.turn is not None:  # P + turn x P, by the velocities that it acts on
        mid_a, mid_b = (J - jax.vmap(jax.vmap(so.cross, (None, 0)))(arms.turn, J) for J in (mid_a, mid_b))

    def answers(J):  # impulses of each contact for unit twists of one of its bodies
        return jnp.swapaxes(jax.vmap(answer)(jnp.swapaxes(J, 0, 1)), 0, 1)

    def block(J, back):  # J^T back, (C, size, size)
        each = jax.vmap(jax.vmap(dot, (None, 0)), (0, None))
        return jax.vmap(each)(J, back)

    if batch:  # else XLA recomputes them for every twist of the other side
        answers = functools.partial(unfused, answers)
    back_a, back_b = answers(J_a), answers(J_b)
    own = side_sum(block(mid_a, back_a), block(mid_b, back_b), arms.a, arms.b, moving)
    diagonal = jnp.eye(moving, dtype=own.dtype).reshape(moving, moving, *[1] * (own.ndim - 1))
    whole = diagonal * own[:, None]
    between = between_bodies(*pairs_of(arms.a, arms.b), moving)
    if between is not None:
        across = [pair_sum(values, arms.a, arms.b) for values in (block(mid_a, back_b), block(mid_b, back_a))]
        whole = whole - sum_rows(jnp.concatenate(across), between).reshape(whole.shape)
    columns = jnp.moveaxis(whole, (1, 3), (0, 1)).reshape(moving * size, moving, size, *batch)

    matrix = jax.vmap(lambda column: _twists(mobility, column[:, :D], column[:, D:]), out_axes=1)(columns)
    return identity(matrix) + matrix


def _by_units(so: Any, arm: Array) -> Array:
    """Velocity at an arm (D, *batch) for each unit twist of its body, (D + A, D, *batch)."""
    size, batch = so.D + so.A, arm.shape[1:]
    units = jnp.eye(size, dtype=arm.dtype).reshape(size, size, *[1] * len(batch))
    return jax.vmap(lambda unit: unit[: so.D] + so.cross(unit[so.D :], arm))(units + jnp.zeros_like(arm[:1])[None])
