"""What keeps the joints of a world: forces, impulses and displacements from the errors of its joints.

With J the Jacobian of all errors by the twists (dx, dtheta) of the bodies and M their mass matrix,

    J M^-1 J^T lam = -(J a + d(J)/dt v)      the forces J^T lam that keep the joints while bodies move freely
    J M^-1 J^T lam = -J v                    the impulses that bring velocities onto the joints
    J M^-1 J^T lam = -error                  the displacements that bring poses onto the joints

J and the rate of J v are derivatives of the error function in forward mode. All of it is differentiable in both
modes, by anchors, axes and lengths too, except where a rod has no length.
Source: Witkin, Physically Based Modeling: Constrained Dynamics, SIGGRAPH 1997 course notes, sections 2 to 4.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.joints import Pose
from diffrigid.numerics import constant, identity, rows, solve_symmetric
from diffrigid.pytree import array, pytree, replace
from diffrigid.state import Bodies, State, Wrench, rotations


@pytree
class Jacobian:
    """J as rows R, with one column for each component of the twist (dx, dtheta) of each body, (D + A) N in all."""

    rows: Array = array("R", "C")  # (R, C, *batch)
    mobile: Array = array("R", "C")  # (R, C, *batch) J M^-1
    error: Array = array("R")  # (R, *batch) [m or rad]
    rate: Array = array("R")  # (R, *batch) dJ/dt v [m/s^2 or rad/s^2]


def jacobian(joints: tuple, statics: Any, bodies: Bodies, state: State) -> Jacobian:
    """Of all joints of a world, which are the rows of some records of many joints each."""
    so, moving = rotations(bodies.dim), state.x.shape[0]
    inverse = jax.vmap(so.world_inverse)(jax.vmap(so.inverse_inertia)(bodies.inertia), state.q)

    def row(joint: Any, a: Pose, b: Pose, v_a: Array, v_b: Array) -> tuple[Array, Array, Array]:
        return differentiated(so, lambda a, b: joint(so, a, b), a, b, v_a, v_b)

    parts = []
    for group in joints:
        error, rate, by_twists = _of_each(row, group, statics, state)
        parts.append((error, rate, _by_bodies(group, by_twists, moving)))
    error, rate, columns = (
        jnp.concatenate([leaf.reshape(-1, *leaf.shape[2:]) for leaf in part]) for part in zip(*parts, strict=True)
    )
    mobile = jax.vmap(lambda row: _mobile(so, bodies, inverse, row))(columns)
    return Jacobian(error=error, rate=rate, rows=columns, mobile=mobile)


def _of_each(row: Callable, group: Any, statics: Any, state: State) -> Any:
    """`row(joint, pose_a, pose_b, twist_a, twist_b)` of every joint of a group."""
    twist = jnp.concatenate([state.v, state.w], axis=1)
    padded = jnp.concatenate([twist, jnp.zeros((len(statics.x) + 1, *twist.shape[1:]), twist.dtype)])
    poses = (_poses(statics, state, ends) for ends in (group.a, group.b))
    twists = (rows(padded, ends) for ends in (group.a, group.b))
    return jax.vmap(row)(replace(group, a=None, b=None), *poses, *twists)


def _by_bodies(group: Any, by_twists: Array, moving: int) -> Array:
    """Jacobians by the twists of a and b (M, E, 2 (D + A), ...), as ones by those of all bodies (M, E, C, ...)."""
    count, size, both, *batch = by_twists.shape
    columns, n = jnp.zeros((1, 1, 1, 1, *[1] * len(batch)), by_twists.dtype), both // 2
    for side, ends in enumerate((group.a, group.b)):
        where = constant(tuple(tuple(float(k == body) for k in range(moving)) for body in ends), str(by_twists.dtype))
        where = where.reshape(count, 1, moving, 1, *[1] * len(batch))
        columns = columns + where * by_twists[:, :, None, side * n : (side + 1) * n]
    return columns.reshape(count, size, moving * n, *batch)


def differentiated(
    so: ModuleType, of: Callable, a: Pose, b: Pose, v_a: Array, v_b: Array
) -> tuple[Array, Array, Array]:
    """What a function of the poses of two bodies is, and how it changes with their motion.

    Args:
        of: (a, b) -> (E, *batch).
        v_a, v_b: (D + A, *batch) twists of the bodies.

    Returns:
        its value (E, *batch); its acceleration (E, *batch) while the twists stay; and its Jacobian by the twists of
        a, then b, (E, 2 (D + A), *batch).
    """
    n, batch = so.D + so.A, a.x.shape[1:]

    def change(poses, v):  # for twists v (2, D + A) of the two bodies
        tangent = tuple(Pose(u[: so.D], so.rate(u[so.D :], pose.q)) for u, pose in zip(v, poses, strict=True))
        return jax.jvp(lambda poses: of(*poses), (poses,), (tangent,))[1]

    v, poses = jnp.stack([v_a, v_b]), (a, b)
    tangent = tuple(Pose(u[: so.D], so.rate(u[so.D :], pose.q)) for u, pose in zip(v, poses, strict=True))
    second = jax.jvp(lambda poses: change(poses, v), (poses,), (tangent,))[1]
    units = jnp.eye(2 * n, dtype=v.dtype).reshape(2 * n, 2, n, *[1] * len(batch)) + jnp.zeros_like(v)[None]
    return of(a, b), second, jax.vmap(lambda unit: change(poses, unit), out_axes=1)(units)


def _mobile(so: ModuleType, bodies: Bodies, inverse: Array, columns: Array) -> Array:
    """M^-1 times forces and torques (C, *batch)."""
    by_body = columns.reshape(bodies.mass.shape[0], so.D + so.A, *columns.shape[1:])
    linear = by_body[:, : so.D] / bodies.mass[:, None]
    return jnp.concatenate([linear, jax.vmap(so.apply)(inverse, by_body[:, so.D :])], axis=1).reshape(columns.shape)


def _poses(statics: Any, state: State, ends: tuple[int, ...]) -> Pose:
    """Of colliders: bodies, then statics, then the world, which stands at the origin."""
    batch = state.x.shape[2:]
    still = [jnp.broadcast_to(leaf, leaf.shape[:2] + batch) for leaf in (statics.x, statics.q)]
    world = jnp.zeros_like(state.x[:1]), jnp.zeros_like(state.q[:1]).at[:, 0].set(1.0)
    x, q = (jnp.concatenate(parts) for parts in zip((state.x, state.q), still, world, strict=True))
    return Pose(rows(x, ends), rows(q, ends))


def islands(joints: tuple, moving: int) -> tuple[tuple[int, ...], ...]:
    """The bodies that hang together with each body by joints, itself included; moving bodies only."""
    together = [{body} for body in range(moving)]
    for group in joints:
        for a, b in zip(group.a, group.b, strict=True):
            if a < moving and b < moving and together[a] is not together[b]:
                together[a] |= together[b]
                for body in together[b]:
                    together[body] = together[a]
    return tuple(tuple(sorted(bodies)) for bodies in together)


@pytree
class Linkage:
    """How joints spread impulses: lam = -inverse (J twist) for a change of the twists of free bodies."""

    rows: Array = array("R", "C")  # (R, C, *batch) J
    mobile: Array = array("R", "C")  # (R, C, *batch) J M^-1
    inverse: Array = array("R", "R")  # (R, R, *batch) of J M^-1 J^T


def linkage(joints: tuple, statics: Any, bodies: Bodies, state: State) -> Linkage:
    """Of the joints of a world at these poses."""
    jac = jacobian(joints, statics, bodies, state)
    matrix = _mobility(jac)
    inverse = jax.vmap(lambda unit: solve_symmetric(matrix, unit))(identity(matrix))
    return Linkage(rows=jac.rows, mobile=jac.mobile, inverse=inverse)


def spread(link: Linkage, dv: Array, dw: Array) -> tuple[Array, Array, Array]:
    """Changes of v, w and L that the joints add to changes dv (N, D, *batch), dw (N, A, *batch) of free bodies."""
    (moving, D), A = dv.shape[:2], dw.shape[1]
    twist = jnp.concatenate([dv, dw], axis=1).reshape(moving * (D + A), *dv.shape[2:])
    lam = -(link.inverse * (link.rows * twist[None]).sum(1)[None]).sum(1)
    moved, forced = (
        (side * lam[:, None]).sum(0).reshape(moving, D + A, *lam.shape[1:]) for side in (link.mobile, link.rows)
    )
    return moved[:, :D], moved[:, D:], forced[:, D:]


def _mobility(jac: Jacobian) -> Array:
    """J M^-1 J^T, (R, R, *batch)."""
    return (jac.rows[:, None] * jac.mobile[None]).sum(2)


def _multipliers(jac: Jacobian, target: Array) -> Array:
    """lam of J M^-1 J^T lam = -target, (R, *batch)."""
    return -solve_symmetric(_mobility(jac), target)


def _columns(jac: Jacobian, lam: Array) -> Array:
    """J M^-1 applied: the twists of all bodies for multipliers lam, (C, *batch)."""
    return (jac.mobile * lam[:, None]).sum(0)


def joint_wrench(joints: tuple, statics: Any, bodies: Bodies, state: State, wrench: Wrench) -> Wrench:
    """The forces of a world with those added that keep its joints."""
    so, moving = rotations(bodies.dim), state.x.shape[0]
    jac = jacobian(joints, statics, bodies, state)
    inverse = jax.vmap(so.world_inverse)(jax.vmap(so.inverse_inertia)(bodies.inertia), state.q)
    damped = _damping(joints, statics, state)
    tau = damped[:, so.D :] + (0.0 if wrench.tau is None else wrench.tau)
    wrench = Wrench(F=wrench.F + damped[:, : so.D], tau=tau)
    gyroscopic = jax.vmap(so.gyroscopic)(bodies.inertia, state.q, state.w)
    free = jnp.concatenate([wrench.F, tau - gyroscopic], axis=1).reshape(-1, *state.x.shape[2:])
    free = _mobile(so, bodies, inverse, free)
    lam = _multipliers(jac, (jac.rows * free[None]).sum(1) + jac.rate)
    forces = (jac.rows * lam[:, None]).sum(0).reshape(moving, so.D + so.A, *state.x.shape[2:])
    return Wrench(F=wrench.F + forces[:, : so.D], tau=tau + forces[:, so.D :])


def _damping(joints: tuple, statics: Any, state: State) -> Array:
    """Forces and torques of the damping of joints, (N, D + A, *batch)."""
    moving, so = state.x.shape[0], rotations(state.x.shape[1])
    total = jnp.zeros((moving, so.D + so.A, *state.x.shape[2:]), state.x.dtype)

    def resisting(joint: Any, a: Pose, b: Pose, v_a: Array, v_b: Array) -> Array:
        along = differentiated(so, lambda a, b: joint.coordinate(so, a, b)[None], a, b, v_a, v_b)[2][0]
        return (-joint.damping * (along * jnp.concatenate([v_a, v_b])).sum(0) * along)[None]

    for group in joints:
        if getattr(group, "damping", None) is not None:
            forces = _by_bodies(group, _of_each(resisting, group, statics, state), moving)
            total = total + forces.sum((0, 1)).reshape(total.shape)
    return total


def onto_joints(joints: tuple, statics: Any, bodies: Bodies, state: State) -> State:
    """The state with poses, then velocities, brought onto the joints, by what joints can do: J^T lam, and no more."""
    so, moving = rotations(bodies.dim), state.x.shape[0]

    def split(columns):
        by_body = columns.reshape(moving, so.D + so.A, *columns.shape[1:])
        return by_body[:, : so.D], by_body[:, so.D :]

    jac = jacobian(joints, statics, bodies, state)
    dx, turn = split(_columns(jac, _multipliers(jac, jac.error)))
    state = replace(state, x=state.x + dx, q=jax.vmap(so.turn_by)(turn, state.q))
    jac = jacobian(joints, statics, bodies, state)
    twist = jnp.concatenate([state.v, state.w], axis=1).reshape(-1, *state.x.shape[2:])
    dv, dw = split(_columns(jac, _multipliers(jac, (jac.rows * twist[None]).sum(1))))
    return replace(state, v=state.v + dv, w=state.w + dw)
