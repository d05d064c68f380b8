"""What keeps the joints of a world: forces, impulses and displacements from the errors of its joints.

With J the Jacobian of all errors by the twists (dx, dtheta) of the bodies and M their mass matrix,

    J M^-1 J^T lam = -(J a + d(J)/dt v)      the forces J^T lam that keep the joints while bodies move freely
    J M^-1 J^T lam = -J v                    the impulses that bring velocities onto the joints
    J M^-1 J^T lam = -error                  the displacements that bring poses onto the joints

J and the rate of J v are derivatives of the error function in forward mode. All of it is differentiable in both
modes, by anchors, axes and lengths too, except where a rod has no length.
Source: Witkin, Physically Based Modeling: Constrained Dynamics, SIGGRAPH 1997 course notes, sections 2 to 4.
"""

import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.elimination import Factor, factorise, plan, substitute
from diffrigid.joints import Pose
from diffrigid.numerics import apart, dot, rows, rows_or_zeros
from diffrigid.pytree import array, pytree, replace, static
from diffrigid.state import Bodies, State, Wrench, rotations


@pytree
class Jacobian:
    """J of n joints by blocks, one for each of the two bodies of a joint; those with fewer errors have rows of zeros."""

    sides: Array = array("n", "2", "E", "D + A")  # by the twists (dx, dtheta) of bodies a and b
    error: Array = array("n", "E")  # [m or rad]
    rate: Array = array("n", "E")  # dJ/dt v [m/s^2 or rad/s^2]


def jacobian(joints: tuple, statics: Any, state: State) -> Jacobian:
    """Of all joints of a world, which are the rows of some records of many joints each."""
    return apart(jnp.ravel(state.x)[0] < jnp.inf, functools.partial(_jacobian, joints, statics), state)


def _jacobian(joints: tuple, statics: Any, state: State) -> Jacobian:
    so, batch = rotations(state.x.shape[1]), state.x.shape[2:]

    def row(joint: Any, a: Pose, b: Pose, v_a: Array, v_b: Array) -> tuple[Array, Array, Array]:
        error, rate, by_twists = differentiated(so, lambda a, b: joint(so, a, b), a, b, v_a, v_b)
        by_sides = by_twists.reshape(len(error), 2, so.D + so.A, *batch)
        return error, rate, jnp.swapaxes(by_sides, 0, 1)

    parts = [_of_each(row, group, statics, state) for group in joints]
    most = max(error.shape[1] for error, _, _ in parts)

    def together(leaves: tuple[Array, ...], axis: int) -> Array:
        def filled(leaf):
            return jnp.pad(leaf, [(0, (most - leaf.shape[axis]) * (k == axis)) for k in range(leaf.ndim)])

        return jnp.concatenate([leaf if leaf.shape[axis] == most else filled(leaf) for leaf in leaves])

    error, rate, sides = zip(*parts, strict=True)
    return Jacobian(error=together(error, 1), rate=together(rate, 1), sides=together(sides, 2))


def _of_each(row: Callable, group: Any, statics: Any, state: State) -> Any:
    """`row(joint, pose_a, pose_b, twist_a, twist_b)` of every joint of a group."""
    twist, poses = _twists(state), (_poses(statics, state, ends) for ends in (group.a, group.b))
    still = jnp.zeros((len(statics.x) + 1, *twist.shape[1:]), twist.dtype)
    twists = (rows(jnp.concatenate([twist, still]), ends) for ends in (group.a, group.b))
    return jax.vmap(row)(replace(group, a=None, b=None), *poses, *twists)


def _twists(state: State) -> Array:
    """(N, D + A, *batch)."""
    return jnp.concatenate([state.v, state.w], axis=1)


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


def ends_of(joints: Any) -> tuple[tuple[int, int], ...]:
    """Colliders a and b of every joint."""
    return tuple(pair for group in joints for pair in zip(group.a, group.b, strict=True))


@pytree
class Linkage:
    """How the n joints of a world act on its N moving bodies."""

    sides: Array = array("n", "2", "E", "D + A")  # J, as in `Jacobian`
    mobile: Array = array("n", "2", "E", "D + A")  # J M^-1
    factors: tuple[Factor, ...] = ()  # of J M^-1 J^T, without derivative
    ends: tuple[tuple[int, int], ...] = static()  # colliders a and b of every joint
    moving: int = static()


def linkage(joints: tuple, bodies: Bodies, q: Array, sides: Array) -> Linkage:
    """Of the joints of a world whose bodies have orientations q, from their Jacobian."""
    so, moving = rotations(bodies.dim), len(q)
    ends = ends_of(joints)
    inverse = jax.vmap(so.world_inverse)(jax.vmap(so.inverse_inertia)(bodies.inertia), q)
    still = tuple(tuple(min(end, moving) for end in pair) for pair in ends)
    inverse, inverse_mass = (
        rows(jnp.concatenate([leaf, jnp.zeros_like(leaf[:1])]), still) for leaf in (inverse, 1.0 / bodies.mass)
    )

    def moved(inverse: Array, inverse_mass: Array, row: Array) -> Array:
        return jnp.concatenate([inverse_mass * row[: so.D], so.apply(inverse, row[so.D :])])

    mobile = jax.vmap(jax.vmap(jax.vmap(moved, (None, None, 0))))(inverse, inverse_mass, sides)
    factors = factorise(plan(ends, moving), lax.stop_gradient(_blocks(ends, moving, sides, mobile)))
    return Linkage(sides=sides, mobile=mobile, factors=factors, ends=ends, moving=moving)


def _blocks(ends: tuple[tuple[int, int], ...], moving: int, sides: Array, mobile: Array) -> Array:
    """Of J M^-1 J^T, as `factorise` takes them: (n + pairs, E, E, *batch)."""
    entry = jax.vmap(jax.vmap(jax.vmap(dot, (None, 0)), (0, None)))
    blocks = [entry(sides[:, 0], mobile[:, 0]) + entry(sides[:, 1], mobile[:, 1])]
    flat, flat_mobile = (leaf.reshape(-1, *leaf.shape[2:]) for leaf in (sides, mobile))
    pairs = plan(ends, moving).pairs
    if pairs:
        shared = [
            [(2 * i + s, 2 * j + t) for s in (0, 1) for t in (0, 1) if ends[i][s] == ends[j][t] < moving]
            for i, j in pairs
        ]
        first = tuple(found[0][0] for found in shared), tuple(found[0][1] for found in shared)
        between = entry(rows(flat, first[0]), rows(flat_mobile, first[1]))
        twice = [found[-1] if len(found) > 1 else (-1, -1) for found in shared]
        if max(twice) > (-1, -1):
            second = entry(*(rows_or_zeros(leaf, tuple(pair[k] for pair in twice)) for k, leaf in enumerate((flat, flat_mobile))))
            between = between + second
        blocks.append(between)
    return jnp.concatenate(blocks)


def joint_rates(sides: Array, ends: tuple[tuple[int, int], ...], twist: Array) -> Array:
    """J u for the twists of all bodies (N, D + A, *batch), (n, E, *batch)."""
    padded = jnp.concatenate([twist, jnp.zeros_like(twist[:1])])
    by_sides = rows(padded, tuple(tuple(min(end, len(twist)) for end in pair) for pair in ends))
    each = jax.vmap(jax.vmap(dot, (0, None)))  # of a joint: its rows
    return each(sides[:, 0], by_sides[:, 0]) + each(sides[:, 1], by_sides[:, 1])


def _on_bodies(link: Linkage, sides: Array, lam: Array) -> Array:
    """Sum over its joints of what every body gets by multipliers (n, E, *batch): forces, or twists of `mobile`."""
    each = sum(sides[:, :, e] * lam[:, None, None, e] for e in range(lam.shape[1]))
    return _by_body(each, link.ends, link.moving)


def _by_body(by_sides: Array, ends: tuple[tuple[int, int], ...], moving: int) -> Array:
    """What both bodies of every joint get (n, 2, ...), summed over the joints of every moving body, (N, ...)."""
    return rows_or_zeros(by_sides.reshape(-1, *by_sides.shape[2:]), _sides_of(ends, moving)).sum(1)


@functools.cache
def _sides_of(ends: tuple[tuple[int, int], ...], moving: int) -> tuple[tuple[int, ...], ...]:
    """For every moving body the sides of joints that are on it, padded by -1."""
    sides = [[2 * i + s for i, pair in enumerate(ends) for s in (0, 1) if pair[s] == body] for body in range(moving)]
    most = max(map(len, sides))
    return tuple(tuple(own + [-1] * (most - len(own))) for own in sides)


def _multipliers(link: Linkage, target: Array) -> Array:
    """lam of J M^-1 J^T lam = -target, for targets (n, E, *batch)."""

    def product(lam: Array) -> Array:
        return joint_rates(link.sides, link.ends, _on_bodies(link, link.mobile, lam))

    def solve(_, right: Array) -> Array:
        return substitute(plan(link.ends, link.moving), link.factors, right)

    return lax.custom_linear_solve(product, -target, solve, symmetric=True)


def spread(link: Linkage, dv: Array, dw: Array) -> tuple[Array, Array, Array]:
    """Changes of v, w and L that the joints add to changes dv (N, D, *batch), dw (N, A, *batch) of free bodies."""
    D = dv.shape[1]
    lam = _multipliers(link, joint_rates(link.sides, link.ends, jnp.concatenate([dv, dw], axis=1)))
    moved, forced = _on_bodies(link, link.mobile, lam), _on_bodies(link, link.sides, lam)
    return moved[:, :D], moved[:, D:], forced[:, D:]


def joint_wrench(joints: tuple, statics: Any, bodies: Bodies, state: State, wrench: Wrench) -> Wrench:
    """The forces of a world with those added that keep its joints."""
    so = rotations(bodies.dim)
    jac = jacobian(joints, statics, state)
    link = linkage(joints, bodies, state.q, jac.sides)
    damped = _damping(joints, statics, state)
    F = wrench.F if damped is None else wrench.F + damped[:, : so.D]
    tau = jnp.zeros_like(state.w) if wrench.tau is None else wrench.tau
    tau = tau if damped is None else tau + damped[:, so.D :]
    gyroscopic = jax.vmap(so.gyroscopic)(bodies.inertia, state.q, state.w)
    inverse = jax.vmap(so.world_inverse)(jax.vmap(so.inverse_inertia)(bodies.inertia), state.q)
    free = jnp.concatenate([F / bodies.mass[:, None], jax.vmap(so.apply)(inverse, tau - gyroscopic)], axis=1)
    forces = _on_bodies(link, link.sides, _multipliers(link, joint_rates(link.sides, link.ends, free) + jac.rate))
    return Wrench(F=F + forces[:, : so.D], tau=tau + forces[:, so.D :])


def _damping(joints: tuple, statics: Any, state: State) -> Array | None:
    """Forces and torques of the damping of joints, (N, D + A, *batch)."""
    so, damped = rotations(state.x.shape[1]), [group for group in joints if getattr(group, "damping", None) is not None]

    def resisting(joint: Any, a: Pose, b: Pose, v_a: Array, v_b: Array) -> Array:
        along = differentiated(so, lambda a, b: joint.coordinate(so, a, b)[None], a, b, v_a, v_b)[2][0]
        forces = -joint.damping * (along * jnp.concatenate([v_a, v_b])).sum(0) * along
        return forces.reshape(2, so.D + so.A, *forces.shape[1:])

    if not damped:
        return None
    forces = jnp.concatenate([_of_each(resisting, group, statics, state) for group in damped])
    return _by_body(forces, ends_of(damped), len(state.x))


def onto_joints(joints: tuple, statics: Any, bodies: Bodies, state: State) -> State:
    """The state with poses and velocities brought onto the joints, by what joints can do: J^T lam, and no more.

    Both by J at the poses as they come, so that the velocities are then on the joints up to the displacement.
    """
    so = rotations(bodies.dim)
    jac = jacobian(joints, statics, state)
    link = linkage(joints, bodies, state.q, jac.sides)
    moved, kicked = (_on_bodies(link, link.mobile, _multipliers(link, off)) for off in (jac.error, joint_rates(link.sides, link.ends, _twists(state))))
    q = jax.vmap(so.turn_by)(moved[:, so.D :], state.q)
    return replace(state, x=state.x + moved[:, : so.D], q=q, v=state.v + kicked[:, : so.D], w=state.w + kicked[:, so.D :])
