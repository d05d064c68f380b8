"""What keeps the joints of a world: forces, impulses and displacements from the errors of its joints.

With J the Jacobian of all errors by the twists (dx, dtheta) of the bodies and M their mass matrix,

    J M^-1 J^T lam = -(J a + d(J)/dt v)      the forces J^T lam that keep the joints while bodies move freely
    J M^-1 J^T lam = -J v                    the impulses that bring velocities onto the joints
    J M^-1 J^T lam = -error                  the displacements that bring poses onto the joints

J u, the rate of J v and J^T lam are derivatives of the error function. All of it is differentiable in both modes, by
anchors, axes and lengths too, except where a rod has no length.
Source: Witkin, Physically Based Modeling: Constrained Dynamics, SIGGRAPH 1997 course notes, sections 2 to 4.
"""

import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.elimination import Factor, factorise, plan, substitute
from diffrigid.joints import Pose
from diffrigid.numerics import apart, dot, rows, rows_or_zeros
from diffrigid.pytree import array, pytree, replace, static
from diffrigid.state import Bodies, State, Wrench, rotations


class Placed(NamedTuple):
    """Joints of one kind, without names, and the poses of their bodies; every leaf with a leading axis M."""

    joint: Any
    a: Pose
    b: Pose


def placed(joints: tuple, statics: Any, x: Array, q: Array) -> tuple[Placed, ...]:
    """All joints of a world whose bodies have poses x (N, D, *batch), q (N, Q, *batch)."""
    every = _poses(statics, x, q)
    return tuple(
        Placed(replace(group, a=None, b=None), *(jax.tree.map(lambda leaf, ends=ends: rows(leaf, ends), every) for ends in (group.a, group.b)))
        for group in joints
    )


def _poses(statics: Any, x: Array, q: Array) -> Pose:
    """Of colliders: bodies, then statics, then the world, which stands at the origin."""
    batch = x.shape[2:]
    still = [jnp.broadcast_to(leaf, leaf.shape[:2] + batch) for leaf in (statics.x, statics.q)]
    world = jnp.zeros_like(x[:1]), jnp.zeros_like(q[:1]).at[:, 0].set(1.0)
    return Pose(*(jnp.concatenate(parts) for parts in zip((x, q), still, world, strict=True)))


def _of_each(row: Callable, groups: tuple[Placed, ...], *args: Array) -> Array:
    """`row(joint, a, b, *args)` of all n joints, (n, E, *batch), for args (n, ...); filled up with zeros to E numbers."""
    parts, start = [], 0
    for group in groups:
        count = len(group.a.x)
        parts.append(jax.vmap(row)(*group, *(arg[start : start + count] for arg in args)))
        start += count
    most = max(part.shape[1] for part in parts)

    def filled(part):
        return jnp.pad(part, [(0, (most - part.shape[1]) * (axis == 1)) for axis in range(part.ndim)])

    return jnp.concatenate([part if part.shape[1] == most else filled(part) for part in parts])


def _change(so: ModuleType, of: Callable, a: Pose, b: Pose, u: Array) -> Array:
    """Rate of a function of(a, b) of the poses of two bodies, for their twists u (2, D + A, *batch)."""
    return jax.jvp(of, (a, b), _tangents(so, a, b, u))[1]


def _tangents(so: ModuleType, a: Pose, b: Pose, u: Array) -> tuple[Pose, Pose]:
    one, other = (Pose(v[: so.D], so.rate(v[so.D :], pose.q)) for v, pose in zip(u, (a, b), strict=True))
    return one, other


def _acceleration(so: ModuleType, of: Callable, a: Pose, b: Pose, u: Array, du: Array) -> Array:
    """Second derivative by time of a function of(a, b), for twists u and their rates du (2, D + A, *batch)."""
    rate = functools.partial(_change, so, of)
    return jax.jvp(rate, (a, b, u), (*_tangents(so, a, b, u), du))[1]


def by_twists(so: ModuleType, of: Callable, a: Pose, b: Pose) -> Array:
    """Jacobian of a function of(a, b) -> (E, *batch) by the twists of a, then b, (E, 2 (D + A), *batch)."""
    n, batch = so.D + so.A, a.x.shape[1:]
    units = jnp.eye(2 * n, dtype=a.x.dtype).reshape(2 * n, 2, n, *[1] * len(batch))
    units = units + jnp.zeros_like(a.x[:1])[None, None]
    return jax.vmap(lambda unit: _change(so, of, a, b, unit), out_axes=1)(units)


def _held(so: ModuleType, joint: Any) -> Callable:
    return lambda a, b: joint(so, a, b)


def _errors(so: ModuleType, groups: tuple[Placed, ...]) -> Array:
    """(n, E, *batch) [m or rad]."""
    return _of_each(lambda joint, a, b: joint(so, a, b), groups)


def joint_rates(so: ModuleType, groups: tuple[Placed, ...], twists: Array) -> Array:
    """J u for the twists u of the bodies of all joints, (n, 2, D + A, *batch) -> (n, E, *batch) [m/s or rad/s]."""
    return _of_each(lambda joint, a, b, u: _change(so, _held(so, joint), a, b, u), groups, twists)


def _accelerations(so: ModuleType, groups: tuple[Placed, ...], twists: Array, rates: Array) -> Array:
    """J du + dJ/dt u for twists u that change at rates du, (n, E, *batch) [m/s^2 or rad/s^2]."""

    def row(joint: Any, a: Pose, b: Pose, u: Array, du: Array) -> Array:
        return _acceleration(so, _held(so, joint), a, b, u, du)

    return _of_each(row, groups, twists, rates)


def _jacobian(so: ModuleType, groups: tuple[Placed, ...]) -> Array:
    """J by blocks, one for each of the two bodies of each joint, (n, E, 2, D + A, *batch)."""
    flat = _of_each(lambda joint, a, b: by_twists(so, _held(so, joint), a, b), groups)
    return flat.reshape(*flat.shape[:2], 2, so.D + so.A, *flat.shape[3:])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _forces(so: ModuleType, sides: Array, groups: tuple[Placed, ...], lam: Array) -> Array:
    """J^T lam on the two bodies of each joint, (n, 2, D + A, *batch), for multipliers (n, E, *batch).

    Args:
        sides: J as `_jacobian` has it. Not differentiated: the derivative of J^T lam is that of the transpose of J u,
            which takes a fraction of the derivative of all columns of J.
    """
    del groups
    return sum(sides[:, e] * lam[:, e, None, None] for e in range(lam.shape[1]))


@_forces.defjvp
def _forces_jvp(so, primals, tangents):
    def transposed(groups, lam):
        like = jax.eval_shape(functools.partial(_forces, so), *primals)
        back = jax.linear_transpose(functools.partial(joint_rates, so, groups), like)
        return back(lam)[0]

    return _forces(so, *primals), jax.jvp(transposed, primals[1:], tangents[1:])[1]


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

    groups: tuple[Placed, ...] = ()
    sides: Array = array("n", "E", "2", "D + A")  # J, without derivative
    factors: tuple[Factor, ...] = ()  # of J M^-1 J^T, without derivative
    inverse_mass: Array = array("N")  # [1/kg]
    inverse_inertia: Array = array("N")  # [1/(kg m^2)] world axes
    ends: tuple[tuple[int, int], ...] = static()  # colliders a and b of every joint


def linkage(joints: tuple, statics: Any, bodies: Bodies, x: Array, q: Array) -> Linkage:
    """Of the joints of a world at these poses (N, D, *batch), (N, Q, *batch)."""
    so, ends = rotations(bodies.dim), ends_of(joints)
    groups, live = placed(joints, statics, x, q), jnp.ravel(x)[0] < jnp.inf
    inverse = jax.vmap(so.world_inverse)(jax.vmap(so.inverse_inertia)(bodies.inertia), q)
    inverse_mass = 1.0 / bodies.mass
    sides = apart(live, functools.partial(_jacobian, so), lax.stop_gradient(groups))
    blocks = _blocks(so, ends, sides, *lax.stop_gradient((inverse_mass, inverse)))
    return Linkage(
        groups=groups, sides=sides, factors=factorise(plan(ends, len(x)), blocks), inverse_mass=inverse_mass,
        inverse_inertia=inverse, ends=ends,
    )  # fmt: skip


def _blocks(so: ModuleType, ends: tuple[tuple[int, int], ...], sides: Array, mass: Array, inertia: Array) -> Array:
    """Of J M^-1 J^T, as `factorise` takes them: (n + pairs, E, E, *batch), from inverse masses and inertias."""
    moving, sides = len(mass), jnp.swapaxes(sides, 1, 2)
    inertia, mass = (
        rows_or_zeros(leaf, tuple(tuple(end if end < moving else -1 for end in pair) for pair in ends))
        for leaf in (inertia, mass)
    )

    def moved(inertia: Array, mass: Array, row: Array) -> Array:
        return jnp.concatenate([mass[None] * row[: so.D], so.apply(inertia, row[so.D :])])

    mobile = jax.vmap(jax.vmap(jax.vmap(moved, (None, None, 0))))(inertia, mass, sides)
    entry = jax.vmap(jax.vmap(jax.vmap(dot, (None, 0)), (0, None)))
    own = entry(sides[:, 0], mobile[:, 0]) + entry(sides[:, 1], mobile[:, 1])
    sides, mobile = (leaf.reshape(-1, *leaf.shape[2:]) for leaf in (sides, mobile))
    shared = [entry(rows_or_zeros(sides, i), rows_or_zeros(mobile, j)) for i, j in _shared(ends, moving)]
    return jnp.concatenate([own, functools.reduce(jnp.add, shared)]) if shared else own


@functools.cache
def _shared(ends: tuple[tuple[int, int], ...], moving: int) -> tuple:
    """For each pair of coupled joints the sides that are on one body, 2 i + s for side s of joint i; twice where both are."""
    found = [
        [(2 * i + s, 2 * j + t) for s in (0, 1) for t in (0, 1) if ends[i][s] == ends[j][t] < moving]
        for i, j in plan(ends, moving).pairs
    ]
    most = max(map(len, found), default=0)
    return tuple(tuple(zip(*((some + [(-1, -1)])[k] for some in found), strict=True)) for k in range(most))


def to_sides(ends: tuple[tuple[int, int], ...], twists: Array) -> Array:
    """Twists of bodies (N, D + A, *batch) at the two ends of every joint, (n, 2, D + A, *batch)."""
    moving = len(twists)
    return rows_or_zeros(twists, tuple(tuple(end if end < moving else -1 for end in pair) for pair in ends))


def _by_body(ends: tuple[tuple[int, int], ...], moving: int, by_sides: Array) -> Array:
    """What both bodies of every joint get (n, 2, ...), summed over the joints of every moving body, (N, ...)."""
    return rows_or_zeros(by_sides.reshape(-1, *by_sides.shape[2:]), _sides_of(ends, moving)).sum(1)


@functools.cache
def _sides_of(ends: tuple[tuple[int, int], ...], moving: int) -> tuple[tuple[int, ...], ...]:
    """For every moving body the sides of joints that are on it, padded by -1."""
    sides = [[2 * i + s for i, pair in enumerate(ends) for s in (0, 1) if pair[s] == body] for body in range(moving)]
    most = max(map(len, sides))
    return tuple(tuple(own + [-1] * (most - len(own))) for own in sides)


def _rates(link: Linkage, twists: Array) -> Array:
    """J u for the twists u of all bodies (N, D + A, *batch), (n, E, *batch)."""
    so = rotations(link.groups[0].a.x.shape[1])
    return joint_rates(so, link.groups, to_sides(link.ends, twists))


def _pull(link: Linkage, lam: Array) -> Array:
    """J^T lam on all bodies, (N, D + A, *batch)."""
    so = rotations(link.groups[0].a.x.shape[1])
    return _by_body(link.ends, len(link.inverse_mass), _forces(so, link.sides, link.groups, lam))


def _moved(link: Linkage, forces: Array) -> Array:
    """M^-1 times forces and torques (N, D + A, *batch)."""
    so = rotations(link.groups[0].a.x.shape[1])
    turn = jax.vmap(so.apply)(link.inverse_inertia, forces[:, so.D :])
    return jnp.concatenate([link.inverse_mass[:, None] * forces[:, : so.D], turn], axis=1)


def _multipliers(link: Linkage, target: Array) -> Array:
    """lam of J M^-1 J^T lam = -target, for targets (n, E, *batch)."""

    def product(lam: Array) -> Array:
        return _rates(link, _moved(link, _pull(link, lam)))

    def solve(_, right: Array) -> Array:
        return substitute(plan(link.ends, len(link.inverse_mass)), link.factors, right)

    return lax.custom_linear_solve(product, -target, solve, symmetric=True)


def spread(link: Linkage, dv: Array, dw: Array) -> tuple[Array, Array, Array]:
    """Changes of v, w and L that the joints add to changes dv (N, D, *batch), dw (N, A, *batch) of free bodies."""
    D = dv.shape[1]
    forced = _pull(link, _multipliers(link, _rates(link, jnp.concatenate([dv, dw], axis=1))))
    moved = _moved(link, forced)
    return moved[:, :D], moved[:, D:], forced[:, D:]


def joint_wrench(joints: tuple, statics: Any, bodies: Bodies, state: State, wrench: Wrench) -> Wrench:
    """The forces of a world with those added that keep its joints."""
    state = apart(jnp.ravel(state.x)[0] < jnp.inf, lambda state: state, state)
    so, link = rotations(bodies.dim), linkage(joints, statics, bodies, state.x, state.q)
    torque = jnp.zeros_like(state.w) if wrench.tau is None else wrench.tau
    given = _damped(joints, link, _twists(state), jnp.concatenate([wrench.F, torque], axis=1))
    gyroscopic = jax.vmap(so.gyroscopic)(bodies.inertia, state.q, state.w)
    free = _moved(link, given.at[:, so.D :].add(-gyroscopic) if so.D == 3 else given)

    def falling(groups: tuple[Placed, ...], twists: Array, free: Array) -> Array:
        return _accelerations(so, groups, *(to_sides(link.ends, leaf) for leaf in (twists, free)))

    target = apart(jnp.ravel(free)[0] < jnp.inf, falling, link.groups, _twists(state), free)
    forces = given + _pull(link, _multipliers(link, target))
    return Wrench(F=forces[:, : so.D], tau=forces[:, so.D :])


def _twists(state: State) -> Array:
    """(N, D + A, *batch)."""
    return jnp.concatenate([state.v, state.w], axis=1)


def _damped(joints: tuple, link: Linkage, twists: Array, forces: Array) -> Array:
    """Forces and torques on all bodies (N, D + A, *batch) with those added of the damping of joints."""
    so = rotations(link.groups[0].a.x.shape[1])

    def resisting(joint: Any, a: Pose, b: Pose, u: Array) -> Array:
        along = by_twists(so, lambda a, b: joint.coordinate(so, a, b)[None], a, b)[0].reshape(u.shape)
        return -joint.damping * (along * u).sum((0, 1)) * along

    for group, at in zip(joints, link.groups, strict=True):
        if getattr(group, "damping", None) is not None:
            ends = ends_of((group,))
            resistance = _of_each(resisting, (at,), to_sides(ends, twists))
            forces = forces + _by_body(ends, len(forces), resistance)
    return forces


def onto_joints(joints: tuple, statics: Any, bodies: Bodies, state: State) -> State:
    """The state with poses and velocities brought onto the joints, by what joints can do: J^T lam, and no more.

    Both by J at the poses as they come, so that the velocities are then on the joints up to the displacement.
    """
    state = apart(jnp.ravel(state.x)[0] < jnp.inf, lambda state: state, state)
    so, link = rotations(bodies.dim), linkage(joints, statics, bodies, state.x, state.q)
    off = jnp.stack([_errors(so, link.groups), _rates(link, _twists(state))])
    moved, kicked = jax.vmap(lambda off: _moved(link, _pull(link, _multipliers(link, off))))(off)
    q = jax.vmap(so.turn_by)(moved[:, so.D :], state.q)
    return State(x=state.x + moved[:, : so.D], q=q, v=state.v + kicked[:, : so.D], w=state.w + kicked[:, so.D :])
