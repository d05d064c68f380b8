"""Impulses at contacts and in joints that explain the changes of momentum along a trajectory. NumPy but for the joints.

In an interval the momenta p and angular momenta L of all bodies change by

    dp, dL  =  what the forces do  +  J^T z

where z are the impulses at the points of contact, those that the errors of the joints transmit, and those along the
angle or translation of a joint where it is at a limit, or where its friction or motor holds it at its speed; one that
does not reach its speed acts with all it has, and is among the forces, as damping is. The z are the smallest (least
norm: where several share a load, equally) that push, with friction within its cone; and rather those of new contacts
than of those that rested before.
"""

import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.constraints import by_twists, joint_jacobian, placed
from diffrigid.elimination import islands
from diffrigid.forces import total_wrench, within
from diffrigid.joints import Pose
from diffrigid.linkage import by_body, ends_of, mobility_along, to_sides, twists_of
from diffrigid.state import State, momentum, rotations, spin
from diffrigid.trajectory import Trajectory
from diffrigid.world import World

SLACK = 1e-3  # [-] of what friction changes in an interval: a rate this close to the speed of a motor is held there
ROUNDING = 8.0  # times that of a number of the size of the rate
SOFT = 1e-9  # [-] of the trace, which makes a singular system regular
RESTED = 0.1  # [-] weight of the impulses of contacts that rested, in the least norm
OUTSIDE = 1e-6  # [-] of the largest impulse: further out of the cone is out
LEFT = 0.05  # [-] of the changes may remain for the sake of the cones
ROWS = 64  # intervals, of which a multiple is looked at
AT_LIMIT = 2e-3  # [rad], or of a size: a joint this close to its limit rests on it


class Joints(NamedTuple):
    """What the joints of a world transmit in each interval, as momenta (p, L) of their bodies a and b by unit impulses.

    The impulses of torques are divided by a length, so that all are in N s.
    """

    ends: np.ndarray  # (2, J) bodies; statics have larger numbers
    made: np.ndarray  # (T, J, E, 2, D + A); 0 where nothing is transmitted


class Changes(NamedTuple):
    """Of each body in each interval."""

    p: np.ndarray  # (T, N, D) [N s] beyond what the forces do
    L: np.ndarray  # (T, N, A) [N m s] likewise
    load: np.ndarray  # (T, N, D + A) [N s], [N m s] by the forces
    fall: np.ndarray  # (T, N, D) [m/s^2] likewise
    push: np.ndarray  # (T, N) [N s] size of the impulse of the forces, on it or on what joints connect it with
    joints: Joints
    gyration: np.ndarray  # (N,) [m] radii, by which what turns is compared with what moves

    def sizes(self) -> np.ndarray:
        """Sizes (T, N) [N s] of the changes."""
        return np.linalg.norm(self.p, axis=2) + np.linalg.norm(self.L, axis=2) / self.gyration


def changes_of(trajectory: Trajectory) -> Changes:
    """Changes of the momenta of all bodies, and what the joints may have to do with them."""
    world, h = trajectory.world, np.diff(trajectory.t)
    dtype, dim = world.bodies.mass.dtype, world.dim
    steps = np.arange(-(-len(h) // ROWS) * ROWS + 1)  # the last again, so that few lengths are compiled
    state = jax.tree.map(lambda leaf: leaf.astype(dtype)[np.minimum(steps, len(h))], trajectory.state)
    lasting = np.minimum(steps[:-1], len(h) - 1)
    controls = jax.tree.map(lambda leaf: leaf[lasting], trajectory.controls)
    *loads, gyration = (np.asarray(leaf, float) for leaf in _loads(world, state, controls, h.astype(dtype)[lasting]))
    momenta, forces, made = (leaf[: len(h) + n] for leaf, n in zip(loads, (1, 0, 0), strict=True))
    change = np.diff(momenta, axis=0) - forces
    push = np.linalg.norm(forces[..., :dim], axis=2) + np.linalg.norm(forces[..., dim:], axis=2) / gyration
    ends = ends_of(world.joints)
    for bodies in set(islands(ends, len(world.names))):
        push[:, bodies] = push[:, bodies].max(1, keepdims=True)
    joints = Joints(np.array(ends, int).reshape(-1, 2).T, made)
    fall = forces[..., :dim] / (np.asarray(world.bodies.mass, float)[:, None] * h[:, None, None])
    return Changes(change[..., :dim], change[..., dim:], forces, fall, push, joints, gyration)


class Touching(NamedTuple):
    """M contacts, each in one interval."""

    interval: np.ndarray  # (M,)
    ends: np.ndarray  # (2, M) bodies; statics have larger numbers
    arms: np.ndarray  # (2, M, D) [m] from their centres
    normal: np.ndarray  # (M, D) from the second to the first; zero: unknown
    friction: np.ndarray  # (M,) [-]
    new: np.ndarray  # (M,) bool: apart at the start of the interval


def impulses_at(changes: Changes, touching: Touching) -> tuple[np.ndarray, np.ndarray]:
    """Impulses (M, D) [N s] at contacts on their first bodies; the second receive the opposite.

    Returns:
        those, and the sizes of the changes that remain, (T, N) [N s]; zero of bodies with joints and no contact.
    """
    interval, ends, arms = touching[:3]
    left = np.where(np.isin(np.arange(changes.p.shape[1]), changes.joints.ends), 0.0, changes.sizes())
    found, moving, joints = np.zeros(arms.shape[1:]), changes.p.shape[1], changes.joints
    order, change = np.argsort(interval, kind="stable"), np.concatenate([changes.p, changes.L], axis=2)
    intervals, firsts = np.unique(interval[order], return_index=True)
    for k, rows in zip(intervals, np.split(order, firsts[1:]), strict=False):
        together = islands([*ends[:, rows].T.tolist(), *joints.ends.T.tolist()], moving)
        label = np.array([bodies[0] for bodies in together])
        island, of_joints = label[ends[:, rows].min(0)], label[joints.ends.min(0)]  # statics have the larger numbers
        for number in np.unique(island):
            bodies, chosen = np.flatnonzero(label == number), rows[island == number]
            place = np.append(np.searchsorted(bodies, np.arange(moving)), len(bodies))  # in the rows of A

            def here(ends, place=place):
                return place[np.minimum(ends, moving)]

            own = np.flatnonzero(of_joints == number)
            A = np.concatenate([
                _by_points(here(ends[:, chosen]), arms[:, chosen], len(bodies), changes.L.shape[2]),
                _by_joints(here(joints.ends[:, own]), joints.made[k, own], len(bodies)),
            ], axis=1)  # fmt: skip
            both = change[k, bodies].ravel(), changes.load[k, bodies].ravel()
            found[chosen], rest = _in_cones(A, *both, *(leaf[chosen] for leaf in touching[3:]))
            p, L = np.split(rest.reshape(len(bodies), -1), [arms.shape[2]], axis=1)
            left[k, bodies] = np.linalg.norm(p, axis=1) + np.linalg.norm(L, axis=1) / changes.gyration[bodies]
    return found, left


def _in_cones(
    A: np.ndarray, change: np.ndarray, load: np.ndarray, normal: np.ndarray, mu: np.ndarray, new: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Impulses (C, D) of the first C D columns of A that push and rub within their cones, and what remains of `change`.

    Where something new strikes, contacts that rested carry the load of the forces as if nothing had. From the least
    beyond that without cones on, contacts that pull are left out, and those that rub too much slide that way; unless
    this explains less.
    """
    count, D = normal.shape
    known = normal.any(1)
    ways = [np.eye(D) * (1.0 if first else RESTED) for first in new]
    columns, others = np.split(A[:, : count * D], count, axis=1), A[:, count * D :]
    support = np.zeros((count, D))
    if new.any() and not new.all():
        at_rest = np.flatnonzero(~new)
        B = np.concatenate([*(columns[c] for c in at_rest), others], axis=1)
        y = _least(B, -load)
        if np.linalg.norm(B @ y + load) <= LEFT * np.linalg.norm(load):
            support[at_rest] = y[: len(at_rest) * D].reshape(-1, D)

    def least() -> tuple[np.ndarray, np.ndarray]:
        B = np.concatenate([*(column @ way for column, way in zip(columns, ways, strict=True)), others], axis=1)
        beyond = change - A[:, : count * D] @ support.ravel()
        y, ends = _least(B, beyond), np.cumsum([way.shape[1] for way in ways])
        P = np.stack([way @ part for way, part in zip(ways, np.split(y[: ends[-1]], ends[:-1]), strict=True)])
        return support + P, beyond - B @ y

    P, left = first = least()
    most = np.linalg.norm(left) + LEFT * np.linalg.norm(change)
    for _ in range(2 * count):
        push = (P * normal).sum(1)
        along = P - push[:, None] * normal
        rub, out = np.linalg.norm(along, axis=1), OUTSIDE * np.abs(P).max()
        pulls = known & (push < min(-out, 0.5 * push.min()))
        slides = known & ~pulls & (rub > mu * push + out) & [way.shape[1] == D for way in ways]
        if not (pulls | slides).any():
            break
        support[pulls | slides] = 0.0
        for c in np.flatnonzero(pulls):
            ways[c] = np.zeros((D, 0))
        for c in np.flatnonzero(slides):
            ways[c] = (normal[c] + mu[c] * along[c] / rub[c])[:, None] * (1.0 if new[c] else RESTED)
        P, left = least()
        if np.linalg.norm(left) > most:
            return first
    return P, left


def _least(B: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The smallest y with B y = change, or nearest to it."""
    square, size = B @ B.T, (B**2).sum()
    return B.T @ np.linalg.solve(square + SOFT * size * np.eye(len(square)), change) if size else np.zeros(B.shape[1])


def _by_points(ends: np.ndarray, arms: np.ndarray, moving: int, A: int) -> np.ndarray:
    """Momenta and angular momenta of all bodies, (N (D + A), C D), by unit impulses at C points on the bodies
    ends (2, C), arms (2, C, D) from their centres: + on the first, - on the second."""
    count, dim = arms.shape[1:]
    made = np.zeros((moving, dim + A, count, dim))
    for side, sign in ((0, 1.0), (1, -1.0)):
        for c, body in enumerate(ends[side]):
            if body < moving:
                made[body, :dim, c] += sign * np.eye(dim)
                made[body, dim:, c] += sign * _moments(arms[side, c])
    return made.reshape(moving * (dim + A), count * dim)


def _moments(r: np.ndarray) -> np.ndarray:
    """Moments (A, D) of the unit impulses along the axes at r (D,)."""
    return np.array([[-r[1], r[0]]]) if len(r) == 2 else np.cross(r, np.eye(3)).T


def _by_joints(ends: np.ndarray, made: np.ndarray, moving: int) -> np.ndarray:
    """Likewise by the unit impulses of C joints, (N (D + A), C E), from `Joints.made` (C, E, 2, D + A)."""
    count, E, _, size = made.shape
    out = np.zeros((moving, size, count, E))
    for side in (0, 1):
        for c, body in enumerate(ends[side]):
            if body < moving:
                out[body, :, c] += made[c, :, side].T
    return out.reshape(moving * size, count * E)


@jax.jit
def _loads(world: World, states: State, controls: Any, h: Array) -> tuple[Array, Array, Array, Array]:
    """Momenta (T+1, N, D + A), impulses of all forces (T, N, D + A), `Joints.made`, radii of gyration (N,) [m].

    Args:
        states: (T+1, ...).
        h: (T,) [s] lengths of the intervals.
    """
    bodies, so = world.bodies, rotations(world.dim)
    moments = bodies.inertia if so.D == 2 else jnp.trace(bodies.inertia, axis1=1, axis2=2) / 3.0
    gyration = jnp.sqrt(moments / bodies.mass)

    def wrench(state: State, controls: Any, h: Array) -> Array:
        found = total_wrench(within(world.forces, h), bodies, state, controls)
        tau = jnp.zeros_like(state.w) if found.tau is None else found.tau
        return jnp.concatenate([found.F, tau], axis=1)

    def momenta(state: State) -> Array:
        return jnp.concatenate([momentum(bodies, state), spin(bodies, state)], axis=1)

    ends = [jax.tree.map(lambda leaf, rows=rows: leaf[rows], states) for rows in (slice(None, -1), slice(1, None))]
    added = 0.5 * h[:, None, None] * sum(jax.vmap(wrench)(end, controls, h) for end in ends)
    made = jnp.zeros((len(h), 0, 1, 2, so.D + so.A), h.dtype)
    if world.joints:
        transmitted: Callable = functools.partial(_transmitted, world, gyration)
        made, driven = jax.vmap(transmitted)(*ends, h)
        added = added + driven
    return jax.vmap(momenta)(states), added, made, gyration


def _transmitted(world: World, gyration: Array, start: State, end: State, h: Array) -> tuple[Array, Array]:
    """`Joints.made` of an interval, (J, E, 2, D + A), and the impulses on all bodies by damping, and by friction and
    motors that do not hold, (N, D + A)."""
    so, bodies, ends = rotations(world.dim), world.bodies, ends_of(world.joints)
    at = [placed(world.joints, world.statics, state.x, state.q) for state in (start, end)]
    inverse = jax.vmap(so.world_inverse)(jax.vmap(so.inverse_inertia)(bodies.inertia), start.q)
    mobility = to_sides(ends, 1.0 / bodies.mass), to_sides(ends, inverse)
    twists: Any = [to_sides(ends, twists_of(state)) for state in (start, end)]
    errors = jnp.mean(jnp.stack([joint_jacobian(so, groups) for groups in at]), axis=0)
    along, known = jnp.zeros_like(errors[:, :1]), jnp.zeros_like(errors[:, 0])
    first = 0
    for before, after in zip(*at, strict=True):
        own = slice(first, first + len(after.a.x))
        if hasattr(after.joint, "coordinate"):
            row: Callable = functools.partial(_driven, so, h)
            args = (after.joint, (before.a, before.b), (after.a, after.b), *(t[own] for t in (*twists, *mobility)))
            held, driven = jax.vmap(row)(*args)
            along, known = along.at[own, 0].set(held), known.at[own].set(driven)
        first = own.stop
    made = jnp.concatenate([errors, along], axis=1)
    turns = (made[..., : so.D] ** 2).sum((2, 3)) == 0  # torques alone
    made = made * jnp.where(turns, to_sides(ends, gyration).max(1)[:, None], 1.0)[..., None, None]
    return made, by_body(ends, len(bodies.mass), known)


def _driven(
    so: ModuleType, h: Array, joint: Any, start: Any, end: Any, u0: Array, u1: Array, mass: Array, inertia: Array
) -> tuple[Array, Array]:
    """Unit impulse (2, D + A) along the coordinate of a joint, 0 where nothing holds it, and the impulse known.

    Args:
        start, end: poses of a and b.
        u0, u1: (2, D + A) their twists.
        mass, inertia: (2,), (2, ...) their inverses, in world axes.
    """

    def coordinate(a: Pose, b: Pose) -> Array:
        return joint.coordinate(so, a, b)[None]

    ways = [by_twists(so, coordinate, *poses)[0].reshape(u0.shape) for poses in (start, end)]
    way = 0.5 * (ways[0] + ways[1])
    rates = [(way * u).sum() for way, u in zip(ways, (u0, u1), strict=True)]
    held, impulse = jnp.asarray(False), jnp.zeros_like(h)
    if joint.damping is not None:
        impulse = impulse - joint.damping * h * 0.5 * (rates[0] + rates[1])
    if joint.friction is not None:
        mobile = mobility_along(so, ways[1], mass, inertia)
        slower = (0.0 if joint.speed is None else joint.speed) - rates[1]
        rounding = ROUNDING * jnp.finfo(h.dtype).eps * jnp.abs(ways[1] * u1).sum()
        slips = jnp.abs(slower) > SLACK * joint.friction * h * mobile + rounding
        held, impulse = ~slips, impulse + jnp.where(slips, joint.friction * h * jnp.sign(slower), 0.0)
    for limit, sign in ((joint.lower, 1.0), (joint.upper, -1.0)):
        if limit is not None:
            gaps = [sign * (coordinate(*poses)[0] - limit) for poses in (start, end)]
            gaps += [gaps[0] + sign * rates[0] * h]
            held = held | (functools.reduce(jnp.minimum, gaps) <= AT_LIMIT * joint.scale(*end))
    return jnp.where(held, way, 0.0), impulse * way
