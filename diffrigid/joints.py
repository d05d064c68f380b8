"""Joints: each a record of anchors and axes, and its error function; everything else is derived from that.

A joint is called as `joint(so, a, b)` with the poses (x, q) of its two bodies and returns its error, (E, *batch)
[m or rad], which is zero where the joint holds. To add one, write such a record and its entry in `JOINTS`.

With J the Jacobian of all errors by the twists (dx, dtheta) of the bodies and M their mass matrix,

    J M^-1 J^T lam = -(J a + d(J)/dt v)      the forces J^T lam that keep the joints while bodies move freely
    J M^-1 J^T lam = -J v                    the impulses that bring velocities onto the joints
    J M^-1 J^T lam = -error                  the displacements that bring poses onto the joints

J and the rate of J v are derivatives of the error function in forward mode. All of it is differentiable in both
modes, by anchors, axes and lengths too, except where a rod has no length.
Source: Witkin, Physically Based Modeling: Constrained Dynamics, SIGGRAPH 1997 course notes, sections 2 to 4.
"""

import dataclasses
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.numerics import constant, dot, identity, norm, rows, solve_symmetric
from diffrigid.pytree import Leaf, array, pytree, replace
from diffrigid.so2 import perp
from diffrigid.so3 import tangents
from diffrigid.state import Bodies, State, Wrench, rotations


class Pose(NamedTuple):
    """Where a body is."""

    x: Array  # (D, *batch) [m] centre of mass
    q: Array  # (Q, *batch)


def _name(default: Any = dataclasses.MISSING) -> Any:
    """Field for the name of a body; in a World, the colliders of all joints of a group."""
    return dataclasses.field(default=default, metadata={"static": True}, kw_only=False)


@pytree
class Revolute:
    """A hinge: two points stay together and, in 3D, two axes stay parallel.

    Anchors and axes are in body axes, from the centre of mass; for `b=None`, the world, anchor_b is a world
    point. What is not given of b is taken from where the bodies are at the start.
    """

    a: Any = _name()
    b: Any = _name(None)
    anchor_a: Leaf = array("D")  # (D, *batch) [m]
    anchor_b: Leaf = array("D", default=None)  # (D, *batch) [m]
    axis_a: Leaf = array("D", default=None)  # (3, *batch) [-] 3D
    axis_b: Leaf = array("D", default=None)  # (3, *batch) [-] 3D

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        apart = separation(self, so, a, b)
        if so.D == 2:
            return apart
        along = so.rotate(a.q, self.axis_a)
        return jnp.concatenate([apart, jnp.stack([dot(so.rotate(b.q, t), along) for t in tangents(self.axis_b)])])


@pytree
class Ball:
    """A ball and socket: two points stay together. Fields as in `Revolute`."""

    a: Any = _name()
    b: Any = _name(None)
    anchor_a: Leaf = array("D")  # (D, *batch) [m]
    anchor_b: Leaf = array("D", default=None)  # (D, *batch) [m]

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        return separation(self, so, a, b)


@pytree
class Weld:
    """Two bodies move as one. Fields as in `Revolute`."""

    a: Any = _name()
    b: Any = _name(None)
    anchor_a: Leaf = array("D", default=0.0)  # (D, *batch) [m]
    anchor_b: Leaf = array("D", default=None)  # (D, *batch) [m]
    q: Leaf = array("Q", default=None)  # (Q, *batch) orientation of a in the axes of b

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        return jnp.concatenate([separation(self, so, a, b), _turn(self, so, a, b)])


@pytree
class Prismatic:
    """A slider: anchor_a stays on the line through anchor_b along axis_b, and a does not turn against b."""

    a: Any = _name()
    b: Any = _name(None)
    anchor_a: Leaf = array("D", default=0.0)  # (D, *batch) [m]
    anchor_b: Leaf = array("D", default=None)  # (D, *batch) [m]
    axis_b: Leaf = array("D")  # (D, *batch) [-] axes of b; of the world where b is None
    q: Leaf = array("Q", default=None)  # (Q, *batch) orientation of a in the axes of b

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        apart = separation(self, so, a, b)
        across = [perp(self.axis_b)] if so.D == 2 else tangents(self.axis_b)
        off_line = jnp.stack([dot(so.rotate(b.q, t), apart) for t in across])
        return jnp.concatenate([off_line, _turn(self, so, a, b)])


@pytree
class Distance:
    """A massless rod between two points. Fields as in `Revolute`."""

    a: Any = _name()
    b: Any = _name(None)
    anchor_a: Leaf = array("D", default=0.0)  # (D, *batch) [m]
    anchor_b: Leaf = array("D")  # (D, *batch) [m]
    length: Leaf = array(default=None)  # (*batch) [m]; None: as at the start

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        return (norm(separation(self, so, a, b)) - self.length)[None]


JOINTS = (Revolute, Ball, Weld, Prismatic, Distance)


def separation(joint: Any, so: ModuleType, a: Pose, b: Pose) -> Array:
    """From anchor b to anchor a, (D, *batch) [m]."""
    return a.x + so.rotate(a.q, joint.anchor_a) - b.x - so.rotate(b.q, joint.anchor_b)


def _turn(joint: Any, so: ModuleType, a: Pose, b: Pose) -> Array:
    """Rotation of a against where it should be in b, (A, *batch) [rad] to first order."""
    return so.sine(so.difference(joint.q, so.difference(b.q, a.q)))


# ---- what keeps the joints of a world


@pytree
class Jacobian:
    """J as rows R, with one column for each component of the twist (dx, dtheta) of each body, (D + A) N in all."""

    rows: Array = array("R", "C")  # (R, C, *batch)
    mobile: Array = array("R", "C")  # (R, C, *batch) J M^-1
    error: Array = array("R")  # (R, *batch) [m or rad]
    rate: Array = array("R")  # (R, *batch) dJ/dt v [m/s^2 or rad/s^2]


def jacobian(joints: tuple, statics: Any, bodies: Bodies, state: State) -> Jacobian:
    """Of all joints of a world, which are the rows of some records of many joints each."""
    so, moving, batch = rotations(bodies.dim), state.x.shape[0], state.x.shape[2:]
    n = so.D + so.A
    twist = jnp.concatenate([state.v, state.w], axis=1)
    inverse = jax.vmap(so.world_inverse)(jax.vmap(so.inverse_inertia)(bodies.inertia), state.q)

    def row(joint: Any, a: Pose, b: Pose, v_a: Array, v_b: Array) -> tuple[Array, Array, Array]:
        def change(poses, v):  # of the error, for twists v (2, D + A) of the two bodies
            tangent = tuple(Pose(u[: so.D], so.rate(u[so.D :], pose.q)) for u, pose in zip(v, poses, strict=True))
            return jax.jvp(lambda poses: joint(so, *poses), (poses,), (tangent,))[1]

        v, poses = jnp.stack([v_a, v_b]), (a, b)
        tangent = tuple(Pose(u[: so.D], so.rate(u[so.D :], pose.q)) for u, pose in zip(v, poses, strict=True))
        second = jax.jvp(lambda poses: change(poses, v), (poses,), (tangent,))[1]
        units = jnp.eye(2 * n, dtype=v.dtype).reshape(2 * n, 2, n, *[1] * len(batch)) + jnp.zeros_like(v)[None]
        return joint(so, a, b), second, jax.vmap(lambda unit: change(poses, unit), out_axes=1)(units)

    parts, padded = [], jnp.concatenate([twist, jnp.zeros((len(statics.x) + 1, *twist.shape[1:]), twist.dtype)])
    for group in joints:
        ends_a, ends_b = group.a, group.b
        poses = _poses(statics, state, ends_a), _poses(statics, state, ends_b)
        twists = rows(padded, ends_a), rows(padded, ends_b)
        ends_removed = replace(group, a=None, b=None)
        error, rate, by_twists = jax.vmap(row)(ends_removed, *poses, *twists)
        columns = jnp.zeros((1, 1, 1, 1, *[1] * len(batch)), error.dtype)
        for side, ends in enumerate((ends_a, ends_b)):
            where = constant(tuple(tuple(float(k == body) for k in range(moving)) for body in ends), str(error.dtype))
            where = where.reshape(len(ends), 1, moving, 1, *[1] * len(batch))
            columns = columns + where * by_twists[:, :, None, side * n : (side + 1) * n]
        parts.append((error, rate, columns.reshape(*columns.shape[:2], moving * n, *batch)))
    error, rate, columns = (
        jnp.concatenate([leaf.reshape(-1, *leaf.shape[2:]) for leaf in part]) for part in zip(*parts, strict=True)
    )
    mobile = jax.vmap(lambda row: _mobile(so, bodies, inverse, row))(columns)
    return Jacobian(error=error, rate=rate, rows=columns, mobile=mobile)


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
    tau = jnp.zeros_like(state.w) if wrench.tau is None else wrench.tau
    gyroscopic = jax.vmap(so.gyroscopic)(bodies.inertia, state.q, state.w)
    free = jnp.concatenate([wrench.F, tau - gyroscopic], axis=1).reshape(-1, *state.x.shape[2:])
    free = _mobile(so, bodies, inverse, free)
    lam = _multipliers(jac, (jac.rows * free[None]).sum(1) + jac.rate)
    forces = (jac.rows * lam[:, None]).sum(0).reshape(moving, so.D + so.A, *state.x.shape[2:])
    return Wrench(F=wrench.F + forces[:, : so.D], tau=tau + forces[:, so.D :])


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
