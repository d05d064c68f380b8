"""Which shapes touch in each interval of a trajectory: when, at what points, along which normals. NumPy.

Those that come together on their free flight from the start of the interval, or lie together through it; corner against
side or face, and in 3D edge against edge, of the cores.
"""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np

from diffrigid.gaps import Convex, gaps, parting_normals, rotated
from diffrigid.hull import hull_faces
from diffrigid.impulses import Changes
from diffrigid.shapes import UNEVEN, Box, HalfSpace, Hull, edges, radius, vertices
from diffrigid.trajectory import Trajectory
from diffrigid.world import World

SLOP = 2e-3  # [-] of the smaller size: gap up to which bodies touch
TOGETHER = 1e-2  # [-] of it: gap up to which other points take part in an impact
STRUCK = 1e-5  # [-] of the impulse of the forces: a smaller change of momentum is none
BEYOND = 1.1  # [-] times the sizes,
FASTER = 1.5  # [-] and times the path at the first speed: what is further apart does not meet
NO_SIZE = 1e-9  # [m, N s] where there is no size, no force
SOON = 1e-3  # [-] of an interval, in which the closing speed at its start is found
BENT = 0.1  # [-] of the path by the forces: a path that deviates more from that of an even force has an impact,
SPIKE = 1.5  # [-] of the accelerations in the intervals beside it: so does a larger one of a body with joints
SUPPORTED = 1.2  # [-] of the impulse of the forces: a support balances them, an impact changes the momentum by more
ASIDE = 1e-6  # [-] of the smaller size: by so much a body is moved to find a normal, which is the rise of the gap,
UNIQUE = 0.01  # [-] and has the length 1 to this, or is none


class Touch(NamedTuple):
    """Contacts of all intervals, in any order; M of them."""

    interval: np.ndarray  # (M,)
    s: np.ndarray  # (M,) [s] since the start of the interval
    new: np.ndarray  # (M,) bool: apart at the start of the interval
    a: np.ndarray  # (M,) colliders
    b: np.ndarray
    point: np.ndarray  # (M, D) [m]
    normal: np.ndarray  # (M, D) from b to a; zero: unknown


class Sampled(NamedTuple):
    """All colliders at the times looked at; those that do not move have no velocity."""

    t: np.ndarray  # (T+1,) [s]
    x: np.ndarray  # (T+1, N + S, D)
    q: np.ndarray  # (T+1, N + S, Q)
    v: np.ndarray  # (T+1, N + S, D)
    w: np.ndarray  # (T+1, N + S, A)
    a: np.ndarray  # (T, N + S, D) [m/s^2] before an impact in the interval; without one, its mean


def touches(world: World, motion: Sampled, changes: Changes) -> Touch:
    """Contacts of all pairs of shapes, but those with uneven ground."""
    groups = [group for group in world.pairs if not isinstance(world.shapes[group.shape_b], UNEVEN)]
    found = [_of_kind(world, group, motion, changes) for group in groups] or [_none(world.dim)]
    return Touch(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _none(dim: int) -> Touch:
    none, vectors = np.zeros(0, int), np.zeros((0, dim))
    return Touch(none, np.zeros(0), none > 0, none, none, vectors, vectors)


def sampled(trajectory: Trajectory, changes: Changes) -> Sampled:
    """All colliders at the times of a trajectory."""
    state, still = trajectory.state, trajectory.world.statics
    count, steps = len(trajectory.world.static_names), len(trajectory.t)

    def joined(moving, rest):
        return np.concatenate([moving, np.broadcast_to(rest, (steps, count, moving.shape[2]))], axis=1)

    x, q = (joined(*both) for both in ((state.x, np.asarray(still.x, float)), (state.q, np.asarray(still.q, float))))
    h, v, mass = np.diff(trajectory.t)[:, None], state.v, np.asarray(trajectory.world.bodies.mass, float)
    even = np.diff(v, axis=0) / h[..., None]
    off = np.linalg.norm(np.diff(state.x, axis=0) - 0.5 * h[..., None] * (v[1:] + v[:-1]), axis=2)
    hit = (np.linalg.norm(changes.p, axis=2) > SUPPORTED * changes.push) | (off > BENT * h * changes.push / mass)
    a = np.where(hit[..., None], changes.fall, even)
    held = np.isin(np.arange(len(mass)), changes.joints.ends)
    a[:, held] = _between_impacts(even[:, held], off[:, held], h)
    a = np.concatenate([a, np.zeros((steps - 1, count, x.shape[2]))], axis=1)
    return Sampled(np.asarray(trajectory.t), x, q, joined(state.v, 0.0), joined(state.w, 0.0), a)


def _between_impacts(even: np.ndarray, off: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Accelerations (T, n, D) of bodies whose joints bend their paths, from the even ones of their intervals.

    In one with an impact, which is larger than those beside it or leaves its parabola, that of the one before.
    """
    size = np.linalg.norm(even, axis=2)
    around = np.pad(size, [(1, 1), (0, 0)], constant_values=np.inf)
    hit = (size > SPIKE * np.minimum(around[:-2], around[2:])) | (off > BENT * h**2 * size)
    before = np.concatenate([np.zeros_like(even[:1]), np.where(hit[..., None], 0.0, even)[:-1]])
    return np.where(hit[..., None], before, even)


def _of_kind(world: World, group: Any, motion: Sampled, changes: Changes) -> Touch:
    """Contacts of all pairs of one kind."""
    sides = _side(world, group.shape_a), _side(world, group.shape_b)
    a, b, rows = np.array(group.a), np.array(group.b), (np.array(group.row_a), np.array(group.row_b))
    h, size = np.diff(motion.t), np.minimum(sides[0].size[rows[0]], sides[1].size[rows[1]])
    change = np.linalg.norm(changes.p, axis=2) + np.linalg.norm(changes.L, axis=2) / max(size.min(), NO_SIZE)
    struck = change > STRUCK * (changes.push + NO_SIZE)
    apart = np.linalg.norm(motion.x[:-1, a] - motion.x[:-1, b], axis=2)
    path = h[:, None] * np.linalg.norm(motion.v[:-1, a] - motion.v[:-1, b], axis=2)
    reach = BEYOND * (sides[0].size[rows[0]] + sides[1].size[rows[1]]) + FASTER * path
    k, pair = np.nonzero(struck.any(1, keepdims=True) & (apart < reach))  # what passes an impact on may not change
    slop, row_a, row_b = SLOP * size[pair], rows[0][pair], rows[1][pair]

    def two(s, chosen=slice(None)):
        """Shapes and poses of both when they have flown freely for s (M,)."""
        poses = [_flown(motion, k[chosen], body[pair[chosen]], s) for body in (a, b)]
        return sides[0].take(row_a[chosen]), poses[0], sides[1].take(row_b[chosen]), poses[1]

    def at(s, chosen=slice(None)):
        """Gaps (M, C) and points (M, C, D) then."""
        return gaps(*two(s, chosen))

    (start, point), (end, _) = at(np.zeros(len(k))), at(h[k])
    poses = [(motion.x[k + 1, body[pair]], motion.q[k + 1, body[pair]]) for body in (a, b)]
    stored, _ = gaps(sides[0].take(row_a), poses[0], sides[1].take(row_b), poses[1])
    with np.errstate(invalid="ignore"):  # of a corner that is over no face
        closing = (start - at(SOON * h[k])[0]) / (SOON * h[k])[:, None]
    fall = np.pad(np.linalg.norm(changes.fall, axis=2), [(0, 0), (0, len(world.static_names))])
    least = np.maximum(slop / h[k], SUPPORTED * h[k] * np.maximum(fall[k, a[pair]], fall[k, b[pair]]))
    apart = (start > slop[:, None]) | (closing > least[:, None])  # or strikes at the start
    close = end <= slop[:, None]
    comes, rests = apart & close, ~apart & (close | (stored <= slop[:, None]))
    s = _meeting(at, h[k], comes)
    gap, there = at(s)
    nearest = np.where(comes, gap, np.inf).min(1, initial=np.inf)
    struck = apart & (gap <= np.minimum(2 * slop + TOGETHER * size[pair], nearest + 4 * slop)[:, None])
    parts = []
    for near, place, t in ((struck & comes.any(1)[:, None], there, s), (rests, point, np.zeros_like(s))):
        row, c = np.nonzero(near & ~_repeated(place, near, 10 * slop))
        some, of = np.unique(row, return_inverse=True)
        normal = _normals(two(t[some], some), size[pair[some]], of, c)
        new = np.full(len(row), near is not rests)
        parts.append(Touch(k[row], t[row], new, a[pair[row]], b[pair[row]], place[row, c], normal))
    return Touch(*map(np.concatenate, zip(*parts, strict=True)))


def _normals(two: tuple, size: np.ndarray, of: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Normals (M, D) at candidates c (M,) of the poses `of` (M,): the rise of the gap as the first body moves.

    Where a corner meets a corner that is none; there the normal of a side or face.
    """
    a, (x, q), b, pose_b = two
    rises = []
    with np.errstate(invalid="ignore"):  # a corner that moves off a face
        for axis in np.eye(x.shape[1]):
            step = ASIDE * size[:, None] * axis
            up, down = (gaps(a, (x + sign * step, q), b, pose_b)[0][of, c] for sign in (1, -1))
            rises.append((up - down) / (2 * ASIDE * size[of]))
        rise = np.stack(rises, axis=1)
        length = np.linalg.norm(rise, axis=1, keepdims=True)
        return np.where(np.abs(length - 1.0) < UNIQUE, rise / length, parting_normals(*two)[of])


def _side(world: World, group: int) -> Convex:
    """Corners, edges and faces of the rows of one entry of `world.shapes`, from the centres of their bodies."""
    records, offset, dim = world.shapes[group], world.offsets[group], world.dim
    shapes = [
        jax.tree.map(lambda leaf, row=row: np.asarray(leaf)[row], records) for row in range(len(world.owners[group]))
    ]
    if isinstance(records, HalfSpace):
        normal = np.asarray(records.normal, float)
        return Convex(None, normal, np.asarray(records.offset, float), (), (), np.full(len(normal), np.inf))
    corners = np.array([vertices(shape, dim) for shape in shapes], float)
    if offset is not None:
        turned = corners if offset.q is None else rotated(np.asarray(offset.q, float)[:, None], corners)
        corners = turned + np.asarray(offset.r, float)[:, None]
    rounding = np.array([radius(shape) for shape in shapes], float)
    count = corners.shape[1]
    if dim == 2:
        sides = tuple((i, (i + 1) % count) for i in range(count if count > 2 else 1))
        faces: tuple = ()
    else:
        sides = edges(shapes[0], dim) or ((0, 0),)
        faces = (records.faces or ()) if isinstance(records, Hull) else _box_faces() if count > 3 else ()
    return Convex(corners, None, rounding, sides, faces, np.linalg.norm(corners, axis=2).max(1) + rounding)


@functools.cache
def _box_faces() -> tuple:
    """Faces of any box, one without thickness included."""
    return tuple(hull_faces(np.array(vertices(Box(half=(1.0, 1.0, 1.0)), 3), float)))


def _flown(motion: Sampled, k: np.ndarray, body: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (M, D), (M, Q) after a free flight of s (M,) without torques, which is near enough within an interval."""
    s = s[:, None]
    x = motion.x[k, body] + s * (motion.v[k, body] + 0.5 * s * motion.a[k, body])
    q, w = motion.q[k, body], s * motion.w[k, body]
    if q.shape[1] == 2:
        c, u = np.cos(w[:, 0]), np.sin(w[:, 0])
        return x, np.stack([c * q[:, 0] - u * q[:, 1], u * q[:, 0] + c * q[:, 1]], axis=1)
    half = 0.5 * np.linalg.norm(w, axis=1, keepdims=True)
    p0, p = np.cos(half), 0.5 * w * np.sinc(half / np.pi)
    first = p0 * q[:, :1] - (p * q[:, 1:]).sum(1, keepdims=True)
    return x, np.concatenate([first, p0 * q[:, 1:] + q[:, :1] * p + np.cross(p, q[:, 1:])], axis=1)


def _meeting(at, h: np.ndarray, comes: np.ndarray) -> np.ndarray:
    """Times (M,) at which the least gap of those that come becomes zero, by bisection; 0 where none comes."""
    s, chosen = np.zeros(len(h)), np.flatnonzero(comes.any(1))
    low, high = np.zeros(len(chosen)), h[chosen].copy()
    for _ in range(14 if len(chosen) else 0):
        middle = (low + high) / 2
        closed = (comes[chosen] & (at(middle, chosen)[0] <= 0)).any(1)
        low, high = np.where(closed, low, middle), np.where(closed, middle, high)
    s[chosen] = high
    return s


def _repeated(point: np.ndarray, near: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Whether candidates (M, C) are at the place of an earlier one of the same pair."""
    repeated, several = np.zeros_like(near), np.flatnonzero(near.sum(1) > 1)
    for row in several:
        chosen = np.flatnonzero(near[row])
        places = point[row, chosen]
        apart = np.linalg.norm(places[:, None] - places[None], axis=2)
        repeated[row, chosen] = np.tril(apart < distance[row], -1).any(1)
    return repeated
