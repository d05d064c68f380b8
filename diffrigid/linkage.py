"""Forces, impulses and displacements that keep the joints of a world, from the errors of the joints.

With J the Jacobian of all errors with respect to the twists (dx, dtheta) of the bodies and M their mass matrix,

    J M^-1 J^T lam = -(J a + d(J)/dt v)      the forces J^T lam that keep the joints while bodies move freely
    J M^-1 J^T lam = -J v                    the impulses that bring velocities onto the joints
    J M^-1 J^T lam = -error                  the displacements that bring poses onto the joints

All of it is differentiable in both modes, by anchors, axes and lengths too, except where a rod has no length.
Source: Witkin, Physically Based Modeling: Constrained Dynamics, SIGGRAPH 1997 course notes, sections 2 to 4.
"""

import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.constraints import (
    PlacedJoints,
    by_twists,
    joint_accelerations,
    joint_errors,
    joint_jacobian,
    of_each,
    placed,
)
from diffrigid.elimination import Factor, factorise, plan_of, solve
from diffrigid.fence import at_hand, unfused
from diffrigid.gathers import rows
from diffrigid.joints import Pose
from diffrigid.numerics import dot
from diffrigid.pytree import array, pytree, static
from diffrigid.state import Bodies, State, Wrench, rotations

STRONGEST = 1.2  # [-] rate of damping times a step; several on one body add up, and from 2.8 on Runge-Kutta is unstable


def ends_of(joints: Any) -> tuple[tuple[int, int], ...]:
    """Colliders a and b of every joint."""
    return tuple(pair for group in joints for pair in zip(group.a, group.b, strict=True))


@pytree
class Linkage:
    """How the n joints of a world act on its N moving bodies."""

    groups: tuple[PlacedJoints, ...] = ()
    sides: Array = array("n", "E", "2", "D + A")  # J
    factors: tuple[Factor, ...] = ()  # of J M^-1 J^T, without derivative
    inverse_mass: Array = array("N")  # [1/kg]
    inverse_inertia: Any = None  # [1/(kg m^2)] world axes
    ends: tuple[tuple[int, int], ...] = static()  # colliders a and b of every joint


def linkage(joints: tuple, statics: Any, bodies: Bodies, x: Array, q: Array) -> Linkage:
    """Linkage of the joints of a world at poses x (N, D, *batch), q (N, Q, *batch)."""
    so, ends = rotations(bodies.dim), ends_of(joints)
    groups = placed(joints, statics, x, q)
    inverse = at_hand(jax.vmap(so.world_inverse)(jax.vmap(so.inverse_inertia)(bodies.inertia), q))
    inverse_mass = 1.0 / bodies.mass
    sides = unfused(functools.partial(joint_jacobian, so), groups)
    blocks = _blocks(so, ends, *lax.stop_gradient((sides, inverse_mass, inverse)))
    return Linkage(
        groups=groups, sides=sides, factors=factorise(plan_of(ends, len(x)), blocks), inverse_mass=inverse_mass,
        inverse_inertia=inverse, ends=ends,
    )  # fmt: skip


def _blocks(so: ModuleType, ends: tuple[tuple[int, int], ...], sides: Array, mass: Array, inertia: Array) -> Array:
    """Blocks of J M^-1 J^T for `factorise`, (n + pairs, E, E, *batch), from inverse masses and inertias."""
    moving, sides = len(mass), jnp.swapaxes(sides, 1, 2)
    inertia, mass = (to_sides(ends, leaf) for leaf in (inertia, mass))

    def moved(inertia: Array, mass: Array, row: Array) -> Array:
        return jnp.concatenate([mass[None] * row[: so.D], so.apply(inertia, row[so.D :])])

    mobile = jax.vmap(jax.vmap(jax.vmap(moved, (None, None, 0))))(inertia, mass, sides)
    entry = jax.vmap(jax.vmap(jax.vmap(dot, (None, 0)), (0, None)))
    own = entry(sides[:, 0], mobile[:, 0]) + entry(sides[:, 1], mobile[:, 1])
    sides, mobile = (leaf.reshape(-1, *leaf.shape[2:]) for leaf in (sides, mobile))
    shared = [entry(rows(sides, i), rows(mobile, j)) for i, j in _shared(ends, moving)]
    return jnp.concatenate([own, functools.reduce(jnp.add, shared)]) if shared else own


@functools.cache
def _shared(ends: tuple[tuple[int, int], ...], moving: int) -> tuple:
    """For each pair of coupled joints, indices 2 i + s (side s of joint i) on a shared body; a table per such body."""
    found = [
        [(2 * i + s, 2 * j + t) for s in (0, 1) for t in (0, 1) if ends[i][s] == ends[j][t] < moving]
        for i, j in plan_of(ends, moving).pairs
    ]
    most = max(map(len, found), default=0)
    return tuple(tuple(zip(*((some + [(-1, -1)])[k] for some in found), strict=True)) for k in range(most))


def to_sides(ends: tuple[tuple[int, int], ...], values: Array) -> Array:
    """Gather values of the bodies (N, ...) at the two ends of every joint, (n, 2, ...); zeros for statics."""
    moving = len(values)
    return rows(values, tuple(tuple(end if end < moving else -1 for end in pair) for pair in ends))


def by_body(ends: tuple[tuple[int, int], ...], moving: int, by_sides: Array) -> Array:
    """Sum values for both bodies of every joint (n, 2, ...) over the joints of each moving body, (N, ...)."""
    return rows(by_sides.reshape(-1, *by_sides.shape[2:]), _sides_of(ends, moving)).sum(1)


@functools.cache
def _sides_of(ends: tuple[tuple[int, int], ...], moving: int) -> tuple[tuple[int, ...], ...]:
    """For each moving body, the sides 2 i + s of joints that are on it, padded by -1."""
    sides = [[2 * i + s for i, pair in enumerate(ends) for s in (0, 1) if pair[s] == body] for body in range(moving)]
    most = max(map(len, sides))
    return tuple(tuple(own + [-1] * (most - len(own))) for own in sides)


def _rates(link: Linkage, twists: Array) -> Array:
    """J u for the twists u of all bodies (N, D + A, *batch), (n, E, *batch)."""
    return (link.sides * to_sides(link.ends, twists)[:, None]).sum((2, 3))


def _pull(link: Linkage, lam: Array) -> Array:
    """J^T lam on all bodies, (N, D + A, *batch)."""
    return by_body(link.ends, len(link.inverse_mass), (link.sides * lam[:, :, None, None]).sum(1))


def _moved(link: Linkage, forces: Array) -> Array:
    """M^-1 times forces and torques (N, D + A, *batch)."""
    so = rotations(link.groups[0].a.x.shape[1])
    turn = jax.vmap(so.apply)(link.inverse_inertia, forces[:, so.D :])
    return jnp.concatenate([link.inverse_mass[:, None] * forces[:, : so.D], turn], axis=1)


def _multipliers(link: Linkage, target: Array) -> Array:
    """Solve J M^-1 J^T lam = -target for lam, with targets (n, E, *batch)."""

    def product(lam: Array) -> Array:
        return _rates(link, _moved(link, _pull(link, lam)))

    solved = functools.partial(solve, plan_of(link.ends, len(link.inverse_mass)), link.factors)
    return lax.custom_linear_solve(product, -target, solved, symmetric=True)


def spread(link: Linkage, dv: Array, dw: Array) -> tuple[Array, Array, Array]:
    """Changes of v, w and L that the joints add to changes dv (N, D, *batch), dw (N, A, *batch) of free bodies."""
    D = dv.shape[1]
    forced = _pull(link, _multipliers(link, _rates(link, jnp.concatenate([dv, dw], axis=1))))
    moved = _moved(link, forced)
    return moved[:, :D], moved[:, D:], forced[:, D:]


def joint_wrench(joints: tuple, statics: Any, bodies: Bodies, state: State, wrench: Wrench, span: Array) -> Wrench:
    """Forces of a world, with the constraint forces of its joints, for an integration over span (*batch) [s]."""
    so, link = rotations(bodies.dim), linkage(joints, statics, bodies, state.x, state.q)
    torque = jnp.zeros_like(state.w) if wrench.tau is None else wrench.tau
    given = _damped(joints, link, twists_of(state), jnp.concatenate([wrench.F, torque], axis=1), span)
    gyroscopic = jax.vmap(so.gyroscopic)(bodies.inertia, state.q, state.w)
    free = _moved(link, given - jnp.pad(gyroscopic, [(0, 0), (so.D, 0), *[(0, 0)] * (given.ndim - 2)]))

    def falling(groups: tuple[PlacedJoints, ...], twists: Array, free: Array) -> Array:
        return joint_accelerations(so, groups, *(to_sides(link.ends, leaf) for leaf in (twists, free)))

    target = unfused(falling, link.groups, twists_of(state), free)
    forces = given + _pull(link, _multipliers(link, target))
    return Wrench(F=forces[:, : so.D], tau=forces[:, so.D :])


def twists_of(state: State) -> Array:
    """Twists (v, w) of all bodies, (N, D + A, *batch)."""
    return jnp.concatenate([state.v, state.w], axis=1)


def _damped(joints: tuple, link: Linkage, twists: Array, forces: Array, span: Array) -> Array:
    """Add the damping of joints to forces and torques on all bodies, (N, D + A, *batch)."""
    for group, at in zip(joints, link.groups, strict=True):
        if is_damped(group):
            forces = forces + _damping(group, at, link, twists, lambda rate: _resolved(rate * span))
    return forces


def is_damped(group: Any) -> bool:
    """Whether there is damping in a group of joints. Static."""
    return getattr(group, "damping", None) is not None


def damped_later(joints: tuple, link: Linkage, twists: Array, momentum: Array, later: Array) -> Array:
    """Momenta of all bodies (N, D + A, *batch), which gave them `twists`, after joints have damped them for a time.

    Args:
        later: (N, *batch) [s] time for which damping has acted since, equal for connected bodies.
    """
    span, taken = later.max(0), jnp.zeros_like(momentum)

    def implicit(rate: Array) -> Array:
        share = _resolved(2.0 * rate * span)
        return share / (1.0 + share * rate * span)

    for group, at in zip(joints, link.groups, strict=True):
        if is_damped(group):
            taken = taken + _damping(group, at, link, twists, implicit)
    return momentum + later[:, None] * taken


def _damping(group: Any, at: PlacedJoints, link: Linkage, twists: Array, share: Callable[[Array], Array]) -> Array:
    """Forces and torques on all bodies (N, D + A, *batch) by the damping of a group of joints.

    Args:
        share: function of the rate [1/s] at which a damping alone would slow its joint: the fraction of it that counts.
    """
    so, ends = rotations(at.a.x.shape[1]), ends_of((group,))

    def resisting(joint: Any, a: Pose, b: Pose, u: Array, mass: Array, inertia: Array) -> Array:
        along = by_twists(so, lambda a, b: joint.coordinate(so, a, b)[None], a, b)[0].reshape(u.shape)
        damping = joint.damping * share(joint.damping * mobility_along(so, along, mass, inertia))
        return -(damping * (along * u).sum((0, 1)))[None, None] * along

    of_both = (to_sides(ends, leaf) for leaf in (twists, link.inverse_mass, link.inverse_inertia))
    return by_body(ends, len(twists), of_each(resisting, (at,), *of_both))


def mobility_along(so: Any, along: Array, mass: Array, inertia: Array) -> Array:
    """J M^-1 J^T of one row `along` (2, D + A, *batch) of two bodies, by their inverse masses (2, *batch) [1/kg] and
    inverse inertias (2, ..., *batch) [1/(kg m^2)] in world axes, (*batch)."""
    turn = along[:, so.D :]
    return (mass * (along[:, : so.D] ** 2).sum(1)).sum(0) + (turn * jax.vmap(so.apply)(inertia, turn)).sum((0, 1))


def _resolved(steps: Array) -> Array:
    """Fraction of a damping that Runge-Kutta can integrate, (*batch), by its rate times the length of a step, `steps`.

    All of it, to a smaller error than that of the method, until it acts within about a step, STRONGEST; beyond that no
    more: a joint that is damped a thousand times as much would be unstable, and is stopped within some steps instead.
    """
    ratio = steps / STRONGEST
    large = ratio > 1.0
    small = jnp.where(large, 1.0 / jnp.where(large, ratio, 1.0), ratio)
    return jnp.where(large, small, 1.0) / (1.0 + small**8) ** 0.125


def onto_joints(joints: tuple, statics: Any, bodies: Bodies, state: State) -> State:
    """Project the poses and velocities of a state onto the joints, along J^T lam, as joints act, and no more.

    Both use J at the poses before, so the velocities then satisfy the joints up to the effect of the displacement.
    """
    state = at_hand(state)
    so, link = rotations(bodies.dim), linkage(joints, statics, bodies, state.x, state.q)
    off = jnp.stack([joint_errors(so, link.groups), _rates(link, twists_of(state))])
    moved, kicked = jax.vmap(lambda off: _moved(link, _pull(link, _multipliers(link, off))))(off)
    q = jax.vmap(so.turn_by)(moved[:, so.D :], state.q)
    return State(x=state.x + moved[:, : so.D], q=q, v=state.v + kicked[:, : so.D], w=state.w + kicked[:, so.D :])
