"""Errors of the joints of a world, and their rates as its bodies move.

J is the Jacobian of all errors with respect to the twists (dx, dtheta) of the bodies. It and the rate of J v are
derivatives of the error function of a joint, in forward mode; smooth wherever that is.
"""

import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.gathers import rows
from diffrigid.joints import Pose
from diffrigid.pytree import replace


class PlacedJoints(NamedTuple):
    """Joints of one kind, without names, and the poses of their bodies; every leaf with a leading axis M."""

    joint: Any
    a: Pose
    b: Pose


def placed(joints: tuple, statics: Any, x: Array, q: Array) -> tuple[PlacedJoints, ...]:
    """All joints of a world whose bodies have poses x (N, D, *batch), q (N, Q, *batch)."""
    every = poses(statics, x, q)

    def at(ends: tuple[int, ...]) -> Pose:
        return Pose(rows(every.x, ends), rows(every.q, ends))

    return tuple(PlacedJoints(replace(group, a=None, b=None), at(group.a), at(group.b)) for group in joints)


def poses(statics: Any, x: Array, q: Array) -> Pose:
    """Poses of all colliders: bodies, then statics, then the world, which is at the origin."""
    batch = x.shape[2:]
    still = [jnp.broadcast_to(leaf, leaf.shape[:2] + batch) for leaf in (statics.x, statics.q)]
    world = jnp.zeros_like(x[:1]), jnp.zeros_like(q[:1]).at[:, 0].set(1.0)
    return Pose(*(jnp.concatenate(parts) for parts in zip((x, q), still, world, strict=True)))


def of_each(row: Callable, groups: tuple[PlacedJoints, ...], *args: Array) -> Array:
    """`row(joint, a, b, *args)` of all n joints, for args (n, ...): (n, E, *batch), padded with zeros to E rows."""
    parts, start = [], 0
    for group in groups:
        count = len(group.a.x)
        parts.append(jax.vmap(row)(*group, *(arg[start : start + count] for arg in args)))
        start += count
    most = max(part.shape[1] for part in parts)

    def filled(part):
        return jnp.pad(part, [(0, (most - part.shape[1]) * (axis == 1)) for axis in range(part.ndim)])

    return jnp.concatenate([part if part.shape[1] == most else filled(part) for part in parts])


def change(so: ModuleType, of: Callable, a: Pose, b: Pose, u: Array) -> Array:
    """Rate of a function of(a, b) of the poses of two bodies, for their twists u (2, D + A, *batch)."""
    return jax.jvp(of, (a, b), _tangents(so, a, b, u))[1]


def _tangents(so: ModuleType, a: Pose, b: Pose, u: Array) -> tuple[Pose, Pose]:
    one, other = (Pose(v[: so.D], so.rate(v[so.D :], pose.q)) for v, pose in zip(u, (a, b), strict=True))
    return one, other


def _acceleration(so: ModuleType, of: Callable, a: Pose, b: Pose, u: Array, du: Array) -> Array:
    """Second time derivative of a function of(a, b), for twists u and their rates du (2, D + A, *batch)."""
    rate = functools.partial(change, so, of)
    return jax.jvp(rate, (a, b, u), (*_tangents(so, a, b, u), du))[1]


def by_twists(so: ModuleType, of: Callable, a: Pose, b: Pose) -> Array:
    """Jacobian of a function of(a, b) -> (E, *batch) for the twists of a, then b, (E, 2 (D + A), *batch)."""
    n, batch = so.D + so.A, a.x.shape[1:]
    units = jnp.eye(2 * n, dtype=a.x.dtype).reshape(2 * n, 2, n, *[1] * len(batch))
    units = units + jnp.zeros_like(a.x[:1])[None, None]
    return jax.vmap(lambda unit: change(so, of, a, b, unit), out_axes=1)(units)


def _held(so: ModuleType, joint: Any) -> Callable:
    """The error of a joint as a function of(a, b)."""
    return lambda a, b: joint(so, a, b)


def joint_errors(so: ModuleType, groups: tuple[PlacedJoints, ...]) -> Array:
    """Errors of all n joints, (n, E, *batch) [m or rad]."""
    return of_each(lambda joint, a, b: joint(so, a, b), groups)


def joint_rates(so: ModuleType, groups: tuple[PlacedJoints, ...], twists: Array) -> Array:
    """J u for the twists u of the bodies of all joints, (n, 2, D + A, *batch) -> (n, E, *batch) [m/s or rad/s]."""
    return of_each(lambda joint, a, b, u: change(so, _held(so, joint), a, b, u), groups, twists)


def joint_accelerations(so: ModuleType, groups: tuple[PlacedJoints, ...], twists: Array, rates: Array) -> Array:
    """J du + dJ/dt u for twists u that change at rates du, (n, E, *batch) [m/s^2 or rad/s^2]."""

    def row(joint: Any, a: Pose, b: Pose, u: Array, du: Array) -> Array:
        return _acceleration(so, _held(so, joint), a, b, u, du)

    return of_each(row, groups, twists, rates)


def joint_jacobian(so: ModuleType, groups: tuple[PlacedJoints, ...]) -> Array:
    """J in blocks, one for each of the two bodies of each joint, (n, E, 2, D + A, *batch)."""
    flat = of_each(lambda joint, a, b: by_twists(so, _held(so, joint), a, b), groups)
    return flat.reshape(*flat.shape[:2], 2, so.D + so.A, *flat.shape[3:])
